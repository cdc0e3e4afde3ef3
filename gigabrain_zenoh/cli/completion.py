"""`gigabrain completion`: TAB in the shell."""

from typing import Literal


def completion(shell: Literal["bash", "zsh", "fish"]) -> None:
    """Print the script that completes commands and options in a shell.

    Example: eval "$(gigabrain completion bash)"

    Parameters
    ----------
    shell
        Which shell.
    """
    from gigabrain_zenoh.cli.app import make_app

    print(make_app().generate_completion(shell=shell))
