"""The README.md of a bundle."""

from collections.abc import Collection, Mapping
from typing import Any

from groundwalk.runtime.preprocessing import Preprocessing
from groundwalk.store.choices import MapUnit

_STEPS = {
    "pinhole": "resample to a pinhole camera with the image's aspect, {short_side_px} px on the shorter side, focal "
    "length {focal_px:.3f} px, principal point in the middle; the camera that took the image has the stated "
    "intrinsics, focal lengths times `focal_factor`, and the distortion (OpenCV's order) of `lens`; beyond the image "
    "its border is repeated",
    "resize": "resize to {short_side_px} px on the shorter side by area",
    "centre_crop": "take the middle {width_px} x {height_px} px",
    "upright_crop": "turn the image about its principal point until gravity, projected into it, points down, and take "
    "the middle {width_px} x {height_px} px; the network's rotation is that of the turned camera: turn it back, then "
    "tilt it in the map by the smallest rotation that has gravity point along -y",
    "normalise": "divide by 255, subtract `mean`, divide by `sd`, channels first: the network's input `image`",
}

_README = """# {label} of {scenes}

A camera pose regressor: an image and its intrinsics in, position and rotation in the map of {scenes} out. Written by
{written_by}, profile {profile}.
{simulated}{reduced}{accuracy}
## Use it

```sh
pip install --no-deps groundwalk
pip install onnxruntime numpy opencv-python-headless typer rich pydantic  # neither PyTorch nor COLMAP
groundwalk locate photo.jpg --bundle . --intrinsics fx,fy,cx,cy
```

```python
from groundwalk.runtime import open_bundle

bundle = open_bundle(".", verify=True)
print(bundle.predict("photo.jpg", intrinsics=(fx, fy, cx, cy)).map_T_cam)
```

## Port it

An image is {size} px or of the same shape, RGB, as the sensor delivers it: not turned by its EXIF.
`preprocessing.json` has the numbers of these steps:

{steps}

The network's outputs are `position` (1, 3) in {unit}, `quaternion` (1, 4) x y z w, `scene` (1), an index of `scenes` in
`bundle.json`, and from some networks `covariance` (1, 6, 6). `frame.json` says what the axes are. `golden/golden.json`
has queries with the output of each step and of each network, and how far a port may be off.

| file | what it is |
|---|---|
{files}
| `preprocessing.json`, `frame.json` | as above |
| `errors.json` | where the run had test frames: errors on them |
| `golden/` | images, the arrays of each step (NumPy's .npy), the outputs |
| `bundle.json` | format, version, sha256 of every file |

{notes}"""


def readme(
    about: Mapping[str, Any], preprocessing: Preprocessing, errors: Mapping[str, Any], units: Collection[MapUnit]
) -> str:
    """What the bundle is and how to use it, for a person who has nothing else; `units` are its maps'."""
    symbol = max(units, key=lambda unit: unit is not MapUnit.METRE).symbol
    scenes = ", ".join(about["scenes"])
    size = "{width_px} x {height_px}".format(**preprocessing.image)
    steps = "\n".join(
        f"{number}. `{step['step']}`: {_STEPS[step['step']].format(**step)}."
        for number, step in enumerate(preprocessing.steps, start=1)
    )
    files = "\n".join(
        f"| `{network['file']}` | the network `{name}`, ONNX, {network['bytes'] / 2**20:.1f} MiB"
        f"{' (recommended)' if name == about['network'] else ''} |"
        for name, network in about["networks"].items()
    )
    if about["coreml"]:
        files += f"\n| `{about['coreml']}` | the network as a Core ML program in half precision |"
    simulated = (
        "\nIts captures are simulated: its accuracy says nothing of a real place.\n" if about["simulated"] else ""
    )
    reduced = f"\nIt is smaller than in its paper: {about['reduced']}.\n" if about["reduced"] else ""
    notes = "".join(f"- {note}\n" for note in about["notes"])
    other = errors.get("frames_of_another_scene")
    elsewhere = f" It takes {other} more test frames for another scene's." if other else ""
    accuracy = (
        f"\nOn the {errors['frames']} test frames it is wrong by {errors['position_median_m']:.2f} {symbol} and "
        f"{errors['rotation_median_deg']:.1f} degrees (medians; means {errors['position_mean_m']:.2f} {symbol}, "
        f"{errors['rotation_mean_deg']:.1f} degrees), in float32.{elsewhere}\n"
        if errors
        else ""
    )
    unit = "metres" if symbol == "m" else "map units, as not all maps are metric"
    texts = {name: about[name] for name in ("label", "written_by", "profile")}
    parts = {"scenes": scenes, "size": size, "steps": steps, "files": files, "notes": notes, "unit": unit}
    return _README.format(**texts, **parts, simulated=simulated, reduced=reduced, accuracy=accuracy)
