"""Identifiers, comments, strings and numbers of C from names and values that may hold anything."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

C_TYPES = {
    "float32": "float", "float64": "double", "bool": "uint8_t",
    **{f"{sign}int{size}": f"{sign}int{size}_t" for sign in ("", "u") for size in (8, 16, 32, 64)},
}  # fmt: skip


class Identifiers:
    """Identifiers of one namespace, each given once."""

    def __init__(self, reserved: tuple[str, ...] = ()) -> None:
        self._given = set(reserved)

    def make(self, prefix: str, name: str, *, upper: bool = False) -> str:
        """Return `prefix` and the letters and digits of `name`, with a number at the end if that is taken.

        The prefix avoids C's keywords and other headers' macros.
        """
        plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")[:64] or "unnamed"
        wanted = f"{prefix}_{plain}"
        wanted = wanted.upper() if upper else wanted
        found, number = wanted, 2
        while found in self._given:
            found, number = f"{wanted}_{number}", number + 1
        self._given.add(found)
        return found


def prefix_of(name: str) -> str:
    """Return the prefix of all of a policy's identifiers: its name, in characters that C allows."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return plain if plain[:1].isalpha() else f"policy_{plain}"


def comment(text: str) -> str:
    """Return text for use in a comment: plain ASCII on one line, that cannot end the comment or join lines."""
    plain = text.encode("unicode_escape").decode("ascii")
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("\\", "|").replace("??/", "?? /")


def string(text: str) -> str:
    """Return a string literal of the text in UTF-8."""
    coded = (
        chr(byte) if chr(byte).isascii() and chr(byte).isprintable() and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in text.encode("utf-8", "replace")
    )
    return f'"{"".join(coded)}"'


def number(value: Any) -> str:
    """Return a numpy number as a literal of its own type, floating-point ones in hexadecimal and so exact."""
    dtype = np.dtype(type(value))
    if dtype.kind == "b":
        return "1" if value else "0"
    if dtype.kind in "iu":
        if value == np.iinfo(dtype.name).min and dtype.kind == "i":
            return f"INT{dtype.itemsize * 8}_MIN"
        return f"{'U' if dtype.kind == 'u' else ''}INT{dtype.itemsize * 8}_C({value})"
    if not np.isfinite(value):
        cast = "" if dtype == np.float32 else "(double)"
        return f"{cast}NAN" if np.isnan(value) else f"{'-' if value < 0 else ''}{cast}INFINITY"
    mantissa, exponent = float(value).hex().split("p")
    if "." in mantissa:
        mantissa = mantissa.rstrip("0").rstrip(".")
    return f"{mantissa}p{exponent}{'f' if dtype == np.float32 else ''}"


def array_text(array: NDArray[Any], indent: str = "    ") -> str:
    """Return the lines of an initializer."""
    items, lines, line = [number(value) for value in array.ravel()], [], indent
    for item in items:
        if len(line) + len(item) > 116:
            lines.append(line.rstrip())
            line = indent
        line += f"{item}, "
    return "\n".join([*lines, line.rstrip()])
