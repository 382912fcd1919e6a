"""Flights as MP4 files."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np

from iif_core.errors import InputError

ENCODERS = {"av1": "libsvtav1", "h264": "libx264"}
OPTIONS = {"av1": {"preset": "8", "crf": "24"}, "h264": {"preset": "medium", "crf": "20"}}
"""Settings of the encoders: good quality, in little time compared with rendering."""
KEYFRAMES = 2
"""Seconds between frames that a player can jump to."""


def require_codec(codec: str, name: str) -> None:
    """Check that a codec can be written.

    Raises:
        InputError: the encoder is not there; the message says `name`, the name of the relighting.
    """
    import av

    if codec in ENCODERS and ENCODERS[codec] in av.codecs_available:
        return
    there = [other for other, encoder in ENCODERS.items() if encoder in av.codecs_available]
    raise InputError(
        f"relight.video.codec of {name}: found {codec!r}, whose encoder {ENCODERS.get(codec, codec)} is not in this installation"
        f" of PyAV; allowed here: {', '.join(there) or 'none'}. Set another codec, or `video: off`"
    )


def encoded(pictures: Iterable[np.ndarray], fps: int, codec: str) -> bytes:
    """Return an MP4 file.

    Args:
        pictures: (H, W, 3) uint8 each, sRGB; an odd height or width is made even by doubling the last row or column.
        fps: frames per second.
        codec: key of `ENCODERS`.

    Raises:
        InputError: the encoder refuses the frames, such as frames that are too large for it.
    """
    os.environ.setdefault("SVT_LOG", "1")  # errors alone
    import av

    try:
        with _scheduled_as_before():
            return _encoded(pictures, fps, codec)
    except av.error.FFmpegError as error:
        raise InputError(
            f"relight.video: {codec} refuses these frames ({error}); set another `codec` or size, or `video: off`. The frames"
            " that were rendered are kept"
        ) from None


@contextmanager
def _scheduled_as_before() -> Iterator[None]:
    """Give this thread its scheduling back: where the user is root, SVT-AV1 makes it a real-time thread, which then takes the
    processor from everything else on the machine, and so do all processes that it starts."""
    if not hasattr(os, "sched_getscheduler"):  # not Linux
        yield
        return
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if os.sched_getscheduler(0) != policy:
            os.sched_setscheduler(0, policy, parameter)


def _encoded(pictures: Iterable[np.ndarray], fps: int, codec: str) -> bytes:
    import av

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream(ENCODERS[codec], rate=fps, options=OPTIONS[codec])
        stream.pix_fmt, height, width = "yuv420p", 0, 0
        context = stream.codec_context
        context.gop_size = KEYFRAMES * fps
        context.color_primaries = context.color_trc = context.colorspace = 1  # BT.709, as sRGB is shown
        context.color_range = 1  # of video
        for picture in pictures:
            if not height:
                height, width = (-(-size // 2) * 2 for size in picture.shape[:2])
                stream.width, stream.height = width, height
            even = np.pad(picture, [(0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0)], "edge")
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return buffer.getvalue()
