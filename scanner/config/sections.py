"""Sections of a configuration whose models live in other packages, found by name as benches are."""

from __future__ import annotations

from importlib.metadata import entry_points

from pydantic import BaseModel

from scanner.config.problems import ConfigError

SECTION_GROUP = "scanner.sections"
"""The entry-point group in which packages register the pydantic model of a section."""


def load_section(name: str) -> type[BaseModel]:
    """Import the model of the section ``name``.

    Raises
    ------
    ConfigError
        No installed package has it, or it cannot be imported.
    """
    for entry in entry_points(group=SECTION_GROUP, name=name):
        try:
            model: type[BaseModel] = entry.load()
        except Exception as error:  # whatever the module raises, the operator needs to know whose it is
            raise ConfigError(
                f"the section {name!r} of {entry.value} cannot be loaded: {type(error).__name__}: {error}",
                "install what it asks for, or remove the section",
            ) from error
        return model
    raise ConfigError(f"no installed package knows a section {name!r}", "remove it, or install the package again")
