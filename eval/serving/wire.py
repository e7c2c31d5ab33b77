"""How a policy server and an evaluation talk: messages in MessagePack, arrays as plain bytes.

``docs/policy-server.md`` describes the protocol. Nothing that is received can run code: MessagePack
holds numbers, text, bytes, lists and maps, and an array is such a map.
"""

from collections.abc import Mapping
from typing import Any, Final

import msgpack
import numpy as np
import numpy.typing as npt

PROTOCOL: Final = 1
MAX_MESSAGE_BYTES: Final = 8 * 2**20
"""Two pictures of 1024 x 1024 x 3 fit; unpacked, a malicious message may take fifty times that."""
MAX_ANSWER_BYTES: Final = 64 * 2**10
"""An action and a line of text: answers need no more."""

DTYPES = {"uint8": "|u1", "float32": "<f4", "float64": "<f8"}
_MAX_DIMENSIONS = 8

Message = dict[str, Any]


class WireError(ValueError):
    """Bytes that are no message of the protocol."""


def encode(message: Mapping[str, Any]) -> bytes:
    """Returns a message as bytes.

    Args:
        message: Text keys; values of plain types, or NumPy arrays of one of `DTYPES`.
    """
    return bytes(msgpack.packb(message, default=_array_to_map))


def decode(content: Any) -> Message:
    """Returns the message in some bytes; its arrays are still maps, see `array`.

    Raises:
        WireError: They hold none.
    """
    if not isinstance(content, bytes):
        raise WireError("a text frame instead of a binary one")
    try:
        message = msgpack.unpackb(content)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise WireError(f"no MessagePack ({type(error).__name__})") from error
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise WireError("a message is a map with a type")
    return message


def array(value: Any) -> npt.NDArray[Any]:
    """Returns the array that a map of ``dtype``, ``shape`` and ``data`` stands for.

    Args:
        value: A value of a decoded message.

    Returns:
        A new array of one of `DTYPES`, which may be written to.

    Raises:
        WireError: It stands for none.
    """
    if not isinstance(value, dict) or set(value) != {"dtype", "shape", "data"}:
        raise WireError("an array is a map of dtype, shape and data")
    dtype, shape, data = value["dtype"], value["shape"], value["data"]
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise WireError(f"dtype {dtype!r} is none of {', '.join(DTYPES)}")
    if (
        not isinstance(shape, list)
        or len(shape) > _MAX_DIMENSIONS
        or not all(type(n) is int and n >= 0 for n in shape)
    ):
        raise WireError("a shape is a list of whole numbers")
    if not isinstance(data, bytes):
        raise WireError("data is bytes")
    size = np.dtype(DTYPES[dtype]).itemsize
    for n in shape:
        size *= n
    if size != len(data):
        raise WireError(f"{len(data)} bytes for {dtype} of shape {tuple(shape)}")
    return np.frombuffer(bytearray(data), DTYPES[dtype]).reshape(shape).astype(dtype, copy=False)


def _array_to_map(value: Any) -> dict[str, Any]:
    if not isinstance(value, np.ndarray) or value.dtype.name not in DTYPES:
        raise TypeError(f"{type(value).__name__} does not travel")
    little = np.ascontiguousarray(value, DTYPES[value.dtype.name])
    return {"dtype": value.dtype.name, "shape": list(value.shape), "data": little.tobytes()}
