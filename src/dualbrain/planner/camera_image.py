"""The camera image that a request may carry to a planner, and its limits."""

from __future__ import annotations

import warnings
from base64 import b64encode
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dualbrain.core.lazy_exports import missing_dependency
from dualbrain.core.untrusted.bounded_file import byte_size, read_bounded_file
from dualbrain.errors import ConfigurationError
from dualbrain.records import Record

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_WIDTH, MAX_HEIGHT = 320, 240
"""Largest size of an image [pixels]: that of the simulated camera, which costs a model a few hundred tokens."""
MAX_IMAGE_BYTES = 40 << 10
"""Largest size of an encoded image [bytes]."""
FORMATS = ("PNG", "JPEG")
JPEG_QUALITY = 85

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FIX = f"Use a PNG or JPEG image of at most {MAX_WIDTH}x{MAX_HEIGHT} pixels and {byte_size(MAX_IMAGE_BYTES)}."


class CameraImage(Record, frozen=True):
    """One encoded image: `data` is a complete PNG or JPEG within the limits of this module.

    Raises `ConfigurationError` for anything else, so that no unchecked bytes reach a server.
    """

    data: bytes

    def __post_init__(self) -> None:
        """Decode the image once."""
        _require_valid(self.data)

    @property
    def media_type(self) -> str:
        """The media type, `image/png` or `image/jpeg`."""
        return "image/png" if self.data.startswith(_PNG_SIGNATURE) else "image/jpeg"

    @property
    def suffix(self) -> str:
        """The suffix of a file with this image."""
        return ".png" if self.media_type == "image/png" else ".jpg"

    @property
    def base64(self) -> str:
        """The image in base64."""
        return b64encode(self.data).decode()

    @property
    def data_url(self) -> str:
        """The image as a `data:` URL."""
        return f"data:{self.media_type};base64,{self.base64}"

    @property
    def sha256(self) -> str:
        """SHA-256 of the encoded image, as hex digits."""
        return sha256(self.data).hexdigest()


def read_camera_image(path: Path) -> CameraImage:
    """The image in the file `path`; raises `ConfigurationError` if it is not one within the limits."""
    return CameraImage(read_bounded_file(path, MAX_IMAGE_BYTES, fix=_FIX))


def encode_camera_image(pixels: NDArray[np.uint8]) -> CameraImage:
    """An RGB image (height, width, 3) as PNG, or as JPEG if the PNG is too large.

    Raises `ConfigurationError` for an image with more pixels than the limits.
    """
    image = _pillow().fromarray(pixels)
    png = BytesIO()
    image.save(png, "PNG", optimize=True)
    if len(png.getvalue()) <= MAX_IMAGE_BYTES:
        return CameraImage(png.getvalue())
    jpeg = BytesIO()
    image.save(jpeg, "JPEG", quality=JPEG_QUALITY)
    return CameraImage(jpeg.getvalue())


def _require_valid(data: bytes) -> None:
    if len(data) > MAX_IMAGE_BYTES:
        raise ConfigurationError.stating(f"The image is larger than {byte_size(MAX_IMAGE_BYTES)}.", fix=_FIX)
    pillow = _pillow()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Pillow warns of huge images
            image = pillow.open(BytesIO(data), formats=FORMATS)
            width, height = image.size
            if width <= MAX_WIDTH and height <= MAX_HEIGHT:
                image.load()
    except Exception as error:  # Pillow raises many types for damaged files
        problem = "The image is not a PNG or JPEG, or it is damaged."
        raise ConfigurationError.stating(problem, fix=_FIX) from error
    if width > MAX_WIDTH or height > MAX_HEIGHT:
        raise ConfigurationError(
            "image size", got=f"{width}x{height}", allowed=f"at most {MAX_WIDTH}x{MAX_HEIGHT} pixels", fix=_FIX
        )


def _pillow() -> Any:
    try:
        from PIL import Image  # noqa: PLC0415  (slow to import, and needed for images only)
    except ModuleNotFoundError as error:
        raise missing_dependency(error, "an image for the planner") from error
    return Image
