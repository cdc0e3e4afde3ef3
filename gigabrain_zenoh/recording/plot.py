"""Numbers of a recording over time, as a picture."""

from collections.abc import Sequence
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.recording.fields import message_of, row
from gigabrain_zenoh.recording.reading import samples

Series = tuple[list[float], list[float]]  # times since the first message [s], values


def series(path: Path, fields: Sequence[str]) -> dict[str, Series]:
    """Each field's values over time. Raises UnknownName for a field that is not in the bag."""
    found: dict[str, Series] = {field: ([], []) for field in fields}
    wanted = {field: _split(field) for field in fields}
    known: set[str] = set()
    first_ns = 0
    for sample in samples(path):
        first_ns = first_ns or sample.log_ns
        short = sample.key.removeprefix("robot/")
        asked = [field for field, (topic, _) in wanted.items() if topic == short]
        if not asked and short in known:
            continue
        message = message_of(sample)
        if message is None:
            continue
        values = row(message)
        if short not in known:
            known |= {short, *(f"{short}.{name}" for name in values)}
        for field in asked:
            value = values.get(wanted[field][1])
            if isinstance(value, int | float):
                found[field][0].append((sample.log_ns - first_ns) / 1e9)
                found[field][1].append(float(value))
    for field, (times, _) in found.items():
        if not times:
            topic = f"{wanted[field][0]}."
            numbers = {name for name in known if name.startswith(topic)}
            topics = {name for name in known if "." not in name}
            raise unknown("number", field, numbers) if numbers else unknown("topic", field, topics)
    return found


def _split(field: str) -> tuple[str, str]:
    topic, _, name = field.removeprefix("robot/").partition(".")
    return topic, name


def plot(path: Path, fields: Sequence[str], to: Path) -> Path:
    """Draw `fields` over time into the PNG file `to`. Raises ConfigError."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ConfigError("plots need matplotlib: pip install 'gigabrain-zenoh[record]'") from None
    if not fields:
        raise ConfigError("name what to draw, such as cmd_vel.linear_x")
    drawn = series(path, fields)
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.subplots()
    for field, (times, values) in drawn.items():
        axes.step(times, values, where="post", label=field, linewidth=1.2)
    axes.set_xlabel("time [s]")
    axes.set_title(path.name)
    axes.grid(alpha=0.3)
    axes.legend()
    try:
        figure.savefig(to, format="png", dpi=110)
    except OSError as error:
        raise ConfigError(f"cannot write {to}: {error.strerror}") from None
    return to
