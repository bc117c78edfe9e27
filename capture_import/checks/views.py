"""Small grey images for the checks of convention, clock and gravity, stored during the scan.

Decoding is most of what import costs. Which images the checks need follows from the poses before any is decoded, but
for those that turn out unusable; others are decoded again.
"""

import heapq
from collections.abc import Container, Iterator, Sequence
from pathlib import Path

from groundwalk.capture_import.capture import Limits, RawFrame
from groundwalk.capture_import.checks.clock import CLOCK_LONG_SIDE, dense_part
from groundwalk.capture_import.checks.convention import CONVENTION_LONG_SIDE, parallax_pairs
from groundwalk.capture_import.checks.gravity import LINES_LONG_SIDE, spread_images
from groundwalk.capture_import.checks.scan import ImageScan, load_gray, scan_images
from groundwalk.capture_import.media.images import WORKING_LONG_SIDE, Gray, shrunk


class Views:
    """Small grey images of one recording, whose files must lie in one of `roots`."""

    def __init__(self, roots: Sequence[Path], limits: Limits) -> None:
        self._roots = roots
        self._limits = limits
        self._stored: dict[tuple[int, int], Gray] = {}

    def scan(self, frames: Sequence[RawFrame], in_colour: Container[int] = ()) -> Iterator[ImageScan | str]:
        """As `scan_images`, storing the views that the checks need."""
        needed = [(frames[i].number, CONVENTION_LONG_SIDE) for pair in parallax_pairs(frames) for i in pair]
        needed += [(frame.number, CLOCK_LONG_SIDE) for frame in dense_part(frames)]
        needed += [(frame.number, LINES_LONG_SIDE) for frame in spread_images(frames)]
        sizes: dict[int, set[int]] = {}
        for number, long_side in needed:
            sizes.setdefault(number, set()).add(long_side)
        for frame, scan in zip(frames, scan_images(frames, self._roots, self._limits, in_colour), strict=True):
            if isinstance(scan, ImageScan):
                for long_side in sizes.get(frame.number, ()):
                    self._stored[frame.number, long_side] = shrunk(scan.gray, long_side)
            yield scan

    def load(self, frames: Sequence[RawFrame], long_side: int) -> Iterator[tuple[RawFrame, Gray]]:
        """The frames in the order of time, each with its image (H, W), scaled down to the long side."""
        stored = [frame for frame in frames if (frame.number, long_side) in self._stored]
        missing = [frame for frame in frames if (frame.number, long_side) not in self._stored]
        ready = ((frame, self._stored[frame.number, long_side]) for frame in stored)
        # By way of the same size as in the scan, so that a run that goes on after a kill sees the same pixels.
        whole = load_gray(missing, WORKING_LONG_SIDE, self._roots, self._limits)
        again = ((frame, shrunk(gray, long_side)) for frame, gray in whole)
        return heapq.merge(ready, again, key=lambda view: view[0].t_ns)
