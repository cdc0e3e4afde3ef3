"""One device on its port: stepped in real time, with its faults."""

import asyncio
from collections.abc import Callable

from gigabrain_drivers.emulators.base import Device, Port, Wire
from gigabrain_drivers.emulators.faults import NONE, Faults, FaultyWire
from gigabrain_zenoh.clock import Clock


class Station:
    """Plugs a device in and runs it. `device` may be looked at, `faults` set at any time."""

    def __init__(self, make: Callable[[Wire], Device], port: Port, clock: Clock) -> None:
        self._port, self._clock = port, clock
        self._wire = FaultyWire(port)
        self.device = make(self._wire)
        self.faults = NONE
        self._task: asyncio.Task[None] | None = None
        port.on_bytes = self._take

    def start(self) -> None:
        """Switch it on."""
        self._port.plug()
        self.device.reset()
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        """Switch it off and take the port away. Any number of times."""
        task, self._task = self._task, None
        if task:
            task.cancel()
            await asyncio.wait((task,))
        self._port.unplug()

    def set(self, faults: Faults) -> None:
        """Have these faults and no others from now on."""
        before, self.faults, self._wire.faults = self.faults, faults, faults
        self.device.sag_volts = faults.brown_out
        if faults.unplugged:
            self._port.unplug()
        else:
            self._port.plug()
        if before.reboot != faults.reboot:  # into reset, with the motors off; or out of it
            self.device.reset()
        if before.frozen and not faults.frozen:
            self._take(b"")

    def _take(self, data: bytes) -> None:
        if data := self._wire.incoming(data):
            self.device.feed(data)

    async def _run(self) -> None:
        async for now_ns in self._clock.every(round(self.device.period_s * 1e9)):
            if not self.faults.reboot:
                self.device.step(now_ns)
