"""What the driver itself makes of an e-stop button that its deployment names."""

from collections.abc import Callable

from gigabrain_schemas.base import Cause
from gigabrain_schemas.safety import ButtonState
from gigabrain_schemas.topics import BUTTON
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.gate import causes as why


class ButtonWatch:
    """Holds the gate shut while the button is pressed, or silent for 200 ms.

    `on_press` is called as soon as it is pressed. Until the button has been heard for the first
    time its silence does not latch.
    """

    def __init__(self, bus: Bus, on_press: Callable[[str], object]) -> None:
        self._on_press = on_press
        self._pressed = self._heard = False
        self._newest = bus.latest(BUTTON, self._take)

    def faults(self) -> tuple[Cause, ...]:
        """What speaks against moving now."""
        state = self._newest.fresh()
        if state is None:
            return (why.BUTTON_LOST if self._heard else why.BUTTON_AWAITED,)
        self._heard = True
        return (why.button(state.text),) if state.pressed else ()

    def _take(self, state: ButtonState) -> None:
        pressed, self._pressed = self._pressed, state.pressed
        if state.pressed and not pressed:
            self._on_press(state.text)
