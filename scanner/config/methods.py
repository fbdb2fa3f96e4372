"""Which methods there are: the scanner's own, those of installed packages, and those of files that were named."""

from __future__ import annotations

import difflib
import importlib.util
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from scanner.config.problems import ConfigError, show

METHOD_GROUP = "scanner.methods"
"""The entry-point group in which packages register their methods; an entry point loads a `scanner.methods.Method`."""

METHOD_NAMES = ("tps", "mps", "mps_gn", "modulated", "embedded", "xor", "epipolar", "mfs_paper", "mfs1", "mfs")
"""Names of the scanner's own methods; `scanner.methods` holds the methods themselves."""

_MEMBERS = ("name", "title", "rounds", "first_round", "collect", "decode", "second_round", "fuse")
_of_files: dict[str, Any] = {}


def method_names() -> tuple[str, ...]:
    """Names of all methods, the scanner's own first; nothing of them is imported."""
    others = {e.name for e in entry_points(group=METHOD_GROUP)} | set(_of_files)
    return METHOD_NAMES + tuple(sorted(others - set(METHOD_NAMES)))


def check_method_name(name: str) -> str:
    """Return ``name``.

    Raises
    ------
    ConfigError
        No method has that name; the error lists those that there are.
    """
    names = method_names()
    if name in names:
        return name
    near = difflib.get_close_matches(name.lower(), names, n=1)
    raise ConfigError(
        f"found {show(name)}, expected {' or '.join(names)}",
        f"did you mean `{near[0]}`?"
        if near
        else f"give one of these names; more come as Python packages that register in the entry-point group "
        f"{METHOD_GROUP}, or as a file: scan --method FILE.py",
    )


def load_stranger(name: str) -> Any:
    """Import the method ``name`` that is not the scanner's own, and check that it has a method's members.

    Raises
    ------
    ConfigError
        None has that name, it cannot be imported, two packages register it, or it is no method.
    """
    if name in _of_files:
        return _of_files[name]
    found = {e.value: e for e in entry_points(group=METHOD_GROUP) if e.name == name}
    if len(found) > 1:
        raise ConfigError(
            f"two packages register the method {name!r}: {' and '.join(found)}", "uninstall one of the two packages"
        )
    if not found:
        check_method_name(name)
    (entry,) = found.values()
    return _checked(_loaded(entry), f"{name!r} of {entry.value}")


def register_file(path: str | Path) -> str:
    """Run a Python file that has a ``method``; from now on this process knows the method under its own name.

    Parameters
    ----------
    path
        The file; its ``method`` is a `scanner.methods.Method`.

    Returns
    -------
    str
        The name of the method.

    Raises
    ------
    ConfigError
        The file cannot be run, has no method, or its name is one of the scanner's own.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file", "correct the path of the method's file")
    spec = importlib.util.spec_from_file_location(f"_method_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the file raises, its author needs to see it
        raise ConfigError(
            f"{path} cannot be run: {type(error).__name__}: {error}", "correct the file; python FILE.py shows where"
        ) from error
    method = _checked(getattr(module, "method", None), f"`method` of {path}")
    if method.name in METHOD_NAMES:
        raise ConfigError(f"{path}: its method is called {method.name!r}, as one of the scanner's own", "rename it")
    _of_files[method.name] = method
    return str(method.name)


def _loaded(entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except Exception as error:  # whatever a stranger's module raises, the operator needs to know whose it is
        raise ConfigError(
            f"the method {entry.name!r} of {entry.value} cannot be loaded: {type(error).__name__}: {error}",
            "install what it asks for, or update its package",
        ) from error


def _checked(method: Any, what: str) -> Any:
    if lacks := [m for m in _MEMBERS if not hasattr(method, m)]:
        raise ConfigError(f"{what} is no method: it lacks {', '.join(lacks)}", "the contract is scanner.methods.Method")
    return method
