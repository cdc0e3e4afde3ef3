"""Descriptions of the patterns of names; errors show them instead of regular expressions."""

import re

NAME_WORDS = {
    r"^\w[\w .-]*$(?!\n)": "of letters, digits, spaces, - _ and ., a letter or digit first",
    r"^(\w[\w-]*)?$(?!\n)": "of letters, digits, - and _, a letter or digit first",
    r"^(?!.*\.(ya?ml|zones)$)\w[\w.-]*$(?!\n)": "of letters, digits, - _ and ., without extension",
    r"^[A-Za-z][A-Za-z0-9_]*$(?!\n)": "of letters, digits and _, a letter first",
    r"^[A-Za-z][A-Za-z0-9_]{0,63}$": "of at most 64 letters, digits and _, a letter first",
    r"^[a-z][a-z0-9_]{0,31}$": "of at most 32 lower-case letters, digits and _, a letter first",
    r"^/([A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*)?$": "such as / or /fleet/red",
    r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*(:[A-Za-z_]\w*)?$": "such as my_package.lamp or my_lamp:run",
    r"^\w+(/\w+)*$": "such as robot/cmd_vel",
    r"^\d{1,6}$": "of 1 to 6 digits",
}
TYPE_WORDS = {
    "`int`": "a whole number",
    "`float`": "a number",
    "`str`": "a string",
    "`bool`": "true or false",
    "`null`": "null",
    "`array`": "a list",
    "`object`": "a mapping",
}
_QUOTED = {repr(pattern): words for pattern, words in NAME_WORDS.items()}


def words_of(pattern: str) -> str:
    """Return a description of the strings that match a pattern."""
    return NAME_WORDS.get(pattern, f"matching {pattern}")


def plain(error: Exception) -> str:
    """Return an error of msgspec as `FIELD: expected …`, in words for people."""
    text, _, path = str(error).partition(" - at `$")
    found = re.fullmatch(r"Expected `str` matching regex ('.*')", text, re.DOTALL)
    if found and found[1] in _QUOTED:
        text = f"Expected a string {_QUOTED[found[1]]}"
    if text.startswith("Expected "):
        text = re.sub("`[a-z]+`", lambda kind: TYPE_WORDS.get(kind[0], kind[0]), f"e{text[1:]}")
    field = path.rstrip("`").removeprefix(".")
    return f"{field}: {text}" if field else text
