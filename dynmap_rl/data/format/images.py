"""Image files in the columns of LeRobot v3.0 datasets."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
from PIL import Image

PNG = b"\x89PNG\r\n\x1a\n"


def image_files(where: Path, name: str, column: pa.ChunkedArray) -> pa.Array:
    """Return the image files of a camera's column.

    Args:
        where: dataset or file of the column, for messages.
        name: the column's name.
        column: its values.

    Raises:
        ValueError: the column does not hold files.
    """
    array = column.combine_chunks()
    try:
        files = array.field("bytes")
    except (AttributeError, KeyError):
        files = None
    if files is None or not pa.types.is_binary(files.type):
        raise ValueError(f"{name} of {where} must hold image files; restore it or record it again")
    return files


def decode_image(file: pa.Buffer | None, largest: int) -> np.ndarray:
    """Decode an image file.

    Args:
        file: content of the file.
        largest: largest number of pixels allowed, as a small file can hold a huge picture.

    Returns:
        uint8 ``[height, width, 3]`` (RGB).

    Raises:
        ValueError: the file cannot be decoded, or has too many pixels. The message is the end of a sentence.
    """
    data = np.frombuffer(file or b"", np.uint8)
    try:
        if data[:8].tobytes() == PNG and data.size >= 24:
            width, height = data[16:24].view(">u4").tolist()
        else:  # takes as long as decoding a small PNG
            width, height = Image.open(io.BytesIO(data)).size
    except (OSError, Image.DecompressionBombError) as error:
        raise ValueError("cannot be decoded") from error
    if width * height > largest:
        raise ValueError(f"must have at most {largest} pixels, got {width} x {height}")
    frame = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    if frame is None:
        raise ValueError("cannot be decoded")
    return frame
