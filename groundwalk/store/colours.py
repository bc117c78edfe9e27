"""One meaning, one colour, in recordings and figures alike (Okabe-Ito, which colour-blind readers can distinguish)."""

from collections.abc import Iterable
from itertools import cycle

GROUND_TRUTH = (0, 158, 115)
VIO = (230, 159, 0)
FUSED = (204, 121, 167)
REJECTED = (213, 94, 0)
NEUTRAL = (150, 150, 150)

# One a localiser, in recordings, figures and on the page. Green is the ground truth's alone, and orange VIO's.
LOCALISERS = {
    "PN": (86, 180, 233),
    "MS-T": (0, 114, 178),
    "Map": (204, 121, 167),
    "HLoc": (120, 60, 20),
    "PN-Lite": (117, 112, 179),
    "HLoc-XFeat": (240, 128, 128),
}
APR = LOCALISERS["PN"]
# Of localisers beyond these.
_MORE = ((120, 94, 240), (90, 60, 150), (110, 110, 60), (200, 60, 200))


def localiser_colours(names: Iterable[str]) -> dict[str, tuple[int, int, int]]:
    """The colour of each of some localisers."""
    more = cycle(_MORE)
    return {name: LOCALISERS.get(name) or next(more) for name in names}
