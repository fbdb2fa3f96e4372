"""What all commands share: options, values from the command line, interruption, and how errors are told."""

from __future__ import annotations

import functools
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, NoReturn, ParamSpec

import typer

INTERRUPTED = 130

ConfigOption = Annotated[Path, typer.Option("--config", "-c", help="Bench file (YAML).", show_default=False)]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing result folder.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Plain lines instead of a progress bar.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Replace a value of the file: scan.steps=8.")
]


P = ParamSpec("P")


def new_app() -> typer.Typer:
    """A command whose errors `run` tells."""
    return typer.Typer(
        add_completion=False,
        no_args_is_help=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def interruptible(command: Callable[P, None]) -> Callable[P, None]:
    """Let Ctrl-C end a command with a word; the result folder has added where the recording was kept."""

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt as interruption:
            print("\n".join(["interrupted", *getattr(interruption, "__notes__", [])]), file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None

    return wrapped


def overrides(sets: list[str] | None, method: str | None = None) -> dict[str, object]:
    """Values from the command line, read as YAML scalars."""
    from ruamel.yaml import YAML

    found: dict[str, object] = {}
    for item in sets or []:
        key, equals, value = item.partition("=")
        if not equals:
            raise typer.BadParameter(f"--set {item}: write KEY=VALUE, such as scan.steps=8")
        found[key.strip()] = YAML(typ="safe").load(value)
    if method is not None:
        found["scan.method"] = method
    return found


@contextmanager
def _terminable() -> Iterator[None]:
    """A request to end (SIGTERM) is treated like Ctrl-C: the light goes out and the recording is closed."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def run(app: typer.Typer) -> NoReturn:
    """Run a command and end the process: every error an operator can meet is a message, never a traceback."""
    try:
        with _terminable():
            code = app(standalone_mode=False)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:
        sys.exit(_explain(error))
    sys.exit(code if isinstance(code, int) else 0)


def _explain(error: Exception) -> int:
    """Show an error that an operator can mend and return its exit code; a fault of the program is raised again."""
    from drivers.errors import OperatorError

    if isinstance(error, OperatorError):
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    show = getattr(error, "show", None)  # what the command-line parser refuses
    if show is None:
        raise error
    show()
    return int(getattr(error, "exit_code", 2))
