"""An e-stop button that somebody can reach."""

from gigabrain_schemas.base import Message, Text


class ButtonState(Message, frozen=True, kw_only=True):
    """What an e-stop button says. Whoever counts on one takes its silence for a press."""

    pressed: bool  # also when nothing is known of the contact
    text: Text = ""  # why it counts as pressed
