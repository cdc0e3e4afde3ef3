"""Escapes the control characters of texts from outside this process."""

import json


# own code: rich's strip_control_codes leaves ESC, which moves the cursor
def printable(text: object) -> str:
    """Return `text` with control characters escaped, so that it cannot move the cursor."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


def printable_json(text: str) -> str:
    """Return a line of JSON with control characters escaped; its value stays the same."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)
