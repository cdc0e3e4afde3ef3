"""Tables whose columns are what was measured."""

from rich.console import Console

from gigabrain_zenoh.cli.bench import side_by_side


def test_four_logs_fit_a_terminal_and_units_are_no_markup() -> None:
    names = ("edmonton", "fhw", "freiburg-079", "intel")
    console = Console(width=80)
    with console.capture() as capture:
        console.print(side_by_side("title", "caption", names, {"graph [m]": ["0.050 ± 0.037"] * 4}))
    lines = capture.get()
    assert "graph [m]" in lines
    assert "…" not in lines
    assert all(name in lines for name in ("title", "caption", *names))
