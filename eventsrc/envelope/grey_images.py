"""PNG and PGM images as numpy arrays; the only importer of Pillow.

Images come from outside, so their size is checked before any pixel is decoded, and only these two
formats are read. docs/decisions/dependencies.md says why Pillow.

Pillow is imported when an image is read: every command imports this module, few need it.
"""

import io
import struct
import warnings
import zlib
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from PIL import Image

Pixels = NDArray[np.uint8]
_FAULTS: Final = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    IndexError,
    KeyError,
    OverflowError,
    struct.error,
    zlib.error,
)
"""Exceptions of Pillow for damaged images; found by `tests/property/test_map_images.py`."""
_WIDE_MODES: Final = ("I", "I;16", "I;16B", "I;16L")
_DEEP_GREY: Final = 257


class BadImage(ValueError):
    """Bytes that are no usable image; the message says why."""


def encode_png(pixels: Pixels) -> bytes:
    """An 8-bit grey PNG of the rows of ``pixels``, from top to bottom."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    return out.getvalue()


def with_few_colours(png: bytes, count: int) -> bytes:
    """A PNG of ours with a palette of so many colours: a fourth of the bytes for a drawing."""
    from PIL import Image

    out = io.BytesIO()
    with Image.open(io.BytesIO(png), formats=("PNG",)) as image:
        image.convert("RGB").quantize(count).save(out, "PNG", optimize=True)
    return out.getvalue()


def decode_grey_png(data: bytes, width: int, height: int) -> Pixels:
    """The rows of an 8-bit grey PNG, from top to bottom. Raises BadImage, also for another size."""
    with _opened(data, ("PNG",)) as image:
        if image.mode != "L":
            raise BadImage(f"it is a PNG of mode {image.mode}, not 8-bit grey")
        if image.size != (width, height):
            raise BadImage(f"it has {_size(image)} pixels, not {width} × {height}")
        return _array(image)


def decode_rgba(data: bytes, max_side: int, max_pixels: int) -> Pixels:
    """Rows of red, green, blue and alpha of a PNG or PGM, shape (height, width, 4), from top to
    bottom. 16-bit grey is scaled to 8 bits. Raises BadImage."""
    with _opened(data, ("PNG", "PPM")) as image:
        width, height = image.size
        if max(width, height) > max_side or width * height > max_pixels:
            raise BadImage(
                f"it has {_size(image)} pixels; a side may have {max_side:,}, all {max_pixels:,}"
            )
        if image.mode not in _WIDE_MODES:
            return _array(image, "RGBA")
        grey = (_array(image).astype(np.int64) // _DEEP_GREY).clip(0, 255).astype(np.uint8)
        return np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1)


def _opened(data: bytes, formats: tuple[str, ...]) -> "Image.Image":
    """An image of which only the header was read. Raises BadImage."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # callers check sizes
            return Image.open(io.BytesIO(data), formats=formats)
    except UnidentifiedImageError:
        raise BadImage(f"it is no {' or '.join(formats).replace('PPM', 'PGM')} image") from None
    except (Image.DecompressionBombError, *_FAULTS) as error:
        raise BadImage(_reason(error)) from None


def _array(image: "Image.Image", mode: str | None = None) -> NDArray[np.uint8]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # such as of a palette with transparency
            return np.asarray(image if mode is None else image.convert(mode))
    except _FAULTS as error:
        raise BadImage(_reason(error)) from None


def _size(image: "Image.Image") -> str:
    return f"{image.size[0]:,} × {image.size[1]:,}"


def _reason(error: Exception) -> str:
    words = " ".join(str(error).split())
    return f"it cannot be read: {words}"
