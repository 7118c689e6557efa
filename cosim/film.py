"""Pictures and films in files: PNG and GIF by Pillow, MP4 (H.264) by PyAV, which brings its encoder along."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import OutputError, ViewError
from cosim.requirements import install_command

Image = NDArray[np.uint8]
"""(height, width, 3), the top row first."""

FILMS: Final = (".mp4", ".gif")
PICTURES: Final = (".png", ".jpg", ".jpeg")

_QUALITY: Final = {"crf": "20", "preset": "veryfast"}


def check_outputs(picture: Path | None, film: Path | None) -> None:
    """Refuse what could not be written at the end, before any work is done.

    Raises:
        ViewError: a suffix of no format that is written, or its library is not installed.
        OutputError: there is no such folder.
    """
    for path, suffixes in ((picture, PICTURES), (film, FILMS)):
        if path is None:
            continue
        if path.suffix.lower() not in suffixes:
            raise ViewError(f"{path}: expected a file that ends in {' or '.join(suffixes)}")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: expected a folder {path.parent} to write it to, found none")
    if film is not None and film.suffix.lower() == ".mp4":
        try:
            import av  # noqa: F401
        except ImportError as error:
            raise ViewError(
                f"{film}: an .mp4 needs PyAV; install it with: {install_command('view')}, or write a .gif"
            ) from error


def write_picture(path: Path, image: Image, *, quickly: bool = False) -> None:
    """Write one picture; `quickly` makes a larger file in a fraction of the time.

    Raises:
        OutputError: it cannot be written.
    """
    from PIL import Image as Pillow

    try:
        picture = Pillow.fromarray(image)
        if quickly:
            picture.save(path, compress_level=1)
        else:
            picture.save(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_film(path: Path, frames: Iterator[Image], rate: float) -> None:
    """Write a film, frame by frame as they come; whatever fails leaves no file behind.

    Args:
        path: .mp4 or .gif; see `check_outputs`.
        frames: at least one, all of one size.
        rate: frames a second.

    Raises:
        OutputError: it cannot be written.
    """
    partial = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        if path.suffix.lower() == ".mp4":
            _write_mp4(partial, frames, rate)
        else:
            _write_gif(partial, frames, rate)
        partial.replace(path)
    except OSError as error:  # PyAV's own errors are of this kind, too
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)


def _write_mp4(path: Path, frames: Iterator[Image], rate: float) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = None
        for frame in frames:
            height, width = (n // 2 * 2 for n in frame.shape[:2])  # colours have half the resolution
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                stream.options = dict(_QUALITY)
            even = np.ascontiguousarray(frame[:height, :width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        assert stream is not None
        container.mux(stream.encode(None))


def _write_gif(path: Path, frames: Iterator[Image], rate: float) -> None:
    from PIL import Image as Pillow

    # The usual median cut gives all colours of a palette to sky and wall, and none to a thin line.
    octree = Pillow.Quantize.FASTOCTREE
    pictures = (Pillow.fromarray(frame).quantize(256, method=octree) for frame in frames)
    next(pictures).save(
        path, save_all=True, append_images=pictures, duration=max(20, round(1000.0 / rate)), loop=0
    )
