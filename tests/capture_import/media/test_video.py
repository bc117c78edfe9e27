"""Frames of a video are told by their time: seeking, lost frames and frames written ahead don't mix them up. HDR
becomes SDR: a chart of known colours, written as a phone writes HDR, comes back in sRGB."""

from pathlib import Path

import av
import numpy as np
import pytest

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.formats.video import read
from groundwalk.capture_import.media.video import HLG, PQ, decode, gray_pixels, rgb_pixels
from tests.capture_import.capture_writers import image, write_video


def write_long_video(path: Path, count: int) -> None:
    """A video with a key frame every second and frames that are stored in another order than they're shown."""
    write_video(path, [image(i) for i in range(count)], 10, bf="2", g="10")


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


# CIE 1931 chromaticities x, y of red, green, blue (BT.2020, BT.709), and of white (D65).
BT2020, BT709 = ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)), ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
WHITE = (0.3127, 0.3290)
PATCH = 32


def xyz_of_rgb(primaries: tuple[tuple[float, float], ...]) -> np.ndarray:
    """The matrix from light in these primaries to CIE XYZ."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (*primaries, WHITE)]).T
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])


def coded(nits: np.ndarray, transfer: int) -> np.ndarray:
    """Codes (N, 3), 0 to 1, by which a display shows light (N, 3) in BT.2020's primaries (BT.2100, inverse EOTF)."""
    if transfer == PQ:
        y = (nits / 10000) ** (2610 / 16384)
        return ((3424 / 4096 + 2413 / 128 * y) / (1 + 2392 / 128 * y)) ** (2523 / 32)
    shown = nits / 1000
    luminance = shown @ [0.2627, 0.6780, 0.0593]
    seen = shown * luminance[:, None] ** ((1 - 1.2) / 1.2)
    return np.where(seen <= 1 / 12, np.sqrt(3 * seen), 0.17883277 * np.log(12 * seen - 0.28466892) + 0.55991073)


def write_chart(path: Path, bt709: np.ndarray, transfer: int) -> np.ndarray:
    """A video of 10 bits with a patch for each colour (N, 3), linear, of which white is 203 cd/m2; their brightness as
    it's coded (N,), 64 to 940."""
    nits = 203 * bt709 @ np.linalg.solve(xyz_of_rgb(BT2020), xyz_of_rgb(BT709)).T
    red, green, blue = coded(nits, transfer).T
    y = 0.2627 * red + 0.6780 * green + 0.0593 * blue
    planes = (64 + 876 * y, 512 + 896 * (blue - y) / 1.8814, 512 + 896 * (red - y) / 1.4746)
    frame = av.VideoFrame(PATCH * len(bt709), PATCH, "yuv420p10le")
    for plane, codes, size in zip(frame.planes, planes, (PATCH, PATCH // 2, PATCH // 2), strict=True):
        row = np.zeros(plane.line_size // 2, np.uint16)
        row[: size * len(bt709)] = np.repeat(np.round(codes), size)
        plane.update(np.tile(row, (size, 1)).tobytes())
    with av.open(path, "w") as container:
        stream = container.add_stream("libx265", rate=30, options={"x265-params": "lossless=1:log-level=none"})
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, "yuv420p10le"
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.colorspace, context.color_range = transfer, 9, 9, 1
        for n in range(3):
            frame.pts = n
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return planes[0]


def srgb(linear: np.ndarray) -> np.ndarray:
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_colours_of_an_hdr_video_come_back(tmp_path: Path, transfer: int) -> None:
    colours = np.random.default_rng(0).uniform(0.004, 0.43, (24, 3))
    # Grey, from nearly black to the knee of the curve; then a colour that is brighter than SDR's white.
    colours[:6] = np.geomspace(0.002, 0.43, 6)[:, None]
    bright = np.array([0.9, 0.5, 0.3]) * np.array([0.4, 0.6, 1.0, 2.0, 4.0])[:, None]
    luma = write_chart(tmp_path / "walk.mov", np.concatenate([colours, bright, np.full((1, 3), 4.9)]), transfer)
    assert any("HDR" in note and "tone-mapped" in note for note in read(tmp_path / "walk.mov", Limits()).notes)
    ((_, frame),) = decode(tmp_path / "walk.mov", {1}, Limits())
    patches = rgb_pixels(frame)[PATCH // 2, PATCH // 2 :: PATCH].astype(float)
    off = np.abs(patches[: len(colours)] - srgb(colours))
    assert off.max() <= 3 and off.mean() <= 0.8, off.max(axis=1)
    # What is brighter stays within range, in order and in hue, and the peak of the display is white.
    assert (np.diff(patches[len(colours) : -1], axis=0) > 1).all() and (patches[-1] >= 254).all()
    linear = ((patches[len(colours) : -1] / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(linear / linear[:, :1], np.tile([1, 5 / 9, 1 / 3], (5, 1)), atol=0.02)
    assert gray_pixels(frame).shape == (PATCH, PATCH * len(luma))
    np.testing.assert_allclose(gray_pixels(frame)[0, ::PATCH], luma / 4, atol=0.7)
