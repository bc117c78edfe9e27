"""Frames of a video are told by their time: seeking, lost frames and frames written ahead don't mix them up."""

from pathlib import Path

import av
import numpy as np
import pytest

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.media.video import decode, gray_pixels, rgb_pixels
from tests.capture_import.capture_writers import HEIGHT, WIDTH, image, video_frame


def write_long_video(path: Path, count: int, rate_hz: int = 10) -> None:
    """A video with a key frame every second and frames that are stored in another order than they're shown."""
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=rate_hz)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": "10", "bf": "2", "g": str(rate_hz)}
        for index in range(count):
            container.mux(stream.encode(video_frame(image(index))))
        container.mux(stream.encode())


def packets(path: Path) -> list[tuple[int, int]]:
    """Position in the file and size of each packet, in the order of storage."""
    with av.open(path) as container:
        return [(p.pos, p.size) for p in container.demux(video=0) if p.size and p.pos is not None]


PICTURES = np.array([image(i)[::4, ::4, ::-1] for i in range(200)]).astype(int)


def looks_like(rgb: np.ndarray) -> int:
    """The index of the test image that this is."""
    return int(np.argmin(np.abs(PICTURES - rgb[::4, ::4]).mean(axis=(1, 2, 3))))


def test_seeking_gives_the_same_frames_as_decoding_all(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    write_long_video(path, 200)
    every = {index: rgb_pixels(frame) for index, frame in decode(path, set(range(200)), Limits())}
    assert list(every) == list(range(200))
    for wanted in ({0}, {199}, {5, 120, 121, 199}, {40, 41, 75, 76, 77, 160}, set(range(60, 90)), {3, 500}):
        found = {index: rgb_pixels(frame) for index, frame in decode(path, wanted, Limits())}
        assert found.keys() == {i for i in wanted if i < 200}
        for index, rgb in found.items():
            np.testing.assert_array_equal(rgb, every[index])
    assert [looks_like(every[i]) for i in (0, 73, 199)] == [0, 73, 199]
    # The plane of brightness holds 16 to 235, the converted image 0 to 255.
    for _, frame in decode(path, {0, 2}, Limits()):
        exact = frame.to_ndarray(format="gray").astype(float)
        np.testing.assert_allclose((gray_pixels(frame).astype(float) - 16) * 255 / 219, exact, atol=2)


@pytest.mark.parametrize("lost", [30, 95])
def test_a_lost_frame_does_not_shift_the_others(tmp_path: Path, lost: int) -> None:
    path = tmp_path / "video.mp4"
    write_long_video(path, 120)
    position, size = packets(path)[lost]
    data = bytearray(path.read_bytes())
    data[position : position + size] = bytes(size)
    path.write_bytes(data)
    found = {index: looks_like(rgb_pixels(frame)) for index, frame in decode(path, set(range(120)), Limits())}
    # Up to the next key frame a decoder may show what it has; before and behind, each frame is itself.
    near = range(lost // 10 * 10 - 3, lost // 10 * 10 + 13)
    assert {i: seen for i, seen in found.items() if i not in near and i != seen} == {}
    assert found.keys() >= set(range(120)) - set(near)
