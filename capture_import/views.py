"""The small grey images that the checks of convention and clock look at, put aside while the scan goes by.

Decoding is most of what import costs. Which images the checks will want is known from the poses before any is decoded,
but for those that turn out unusable; what is wanted beyond that is decoded again.
"""

import heapq
from collections.abc import Container, Iterator, Sequence
from pathlib import Path

from groundwalk.capture_import.capture import Limits, RawFrame
from groundwalk.capture_import.clock import CLOCK_LONG_SIDE, dense_stretch
from groundwalk.capture_import.convention import CONVENTION_LONG_SIDE, parallax_pairs
from groundwalk.capture_import.images import Gray, shrunk
from groundwalk.capture_import.scan import Look, load_gray, scan_images


class Views:
    """Small grey images of one recording, whose files must lie in one of `roots`."""

    def __init__(self, roots: Sequence[Path], limits: Limits) -> None:
        self._roots = roots
        self._limits = limits
        self._kept: dict[tuple[int, int], Gray] = {}

    def scan(self, frames: Sequence[RawFrame], in_colour: Container[int] = ()) -> Iterator[Look | str]:
        """As `scan_images`, with the views put aside that the checks will want."""
        wanted = [(frames[i].number, CONVENTION_LONG_SIDE) for pair in parallax_pairs(frames) for i in pair]
        wanted += [(frame.number, CLOCK_LONG_SIDE) for frame in dense_stretch(frames)]
        sizes: dict[int, set[int]] = {}
        for number, long_side in wanted:
            sizes.setdefault(number, set()).add(long_side)
        for frame, look in zip(frames, scan_images(frames, self._roots, self._limits, in_colour), strict=True):
            if isinstance(look, Look):
                for long_side in sizes.get(frame.number, ()):
                    self._kept[frame.number, long_side] = shrunk(look.gray, long_side)
            yield look

    def load(self, frames: Sequence[RawFrame], long_side: int) -> Iterator[tuple[RawFrame, Gray]]:
        """The frames in the order of time, each with its image (H, W), scaled down to the long side."""
        kept = [frame for frame in frames if (frame.number, long_side) in self._kept]
        missing = [frame for frame in frames if (frame.number, long_side) not in self._kept]
        ready = ((frame, self._kept[frame.number, long_side]) for frame in kept)
        again = load_gray(missing, long_side, self._roots, self._limits)
        return heapq.merge(ready, again, key=lambda view: view[0].t_ns)
