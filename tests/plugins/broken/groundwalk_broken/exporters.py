from pathlib import Path

from groundwalk.export.dataset import Dataset, Images
from groundwalk.export.exporters import Exporter


def write(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    return []


NO_PATHS = Exporter(
    id="no_paths", label="no paths", meaning="writes nothing", write=write, distortion_coefficients=None
)
