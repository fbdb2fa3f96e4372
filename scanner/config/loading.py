"""From a file to a valid configuration, and from that to the file that a result keeps."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError

from scanner.config.models import Config, ScanSection
from scanner.config.problems import ConfigError, FieldPath
from scanner.config.schema import schema_for
from scanner.config.source import Source, read_source

if TYPE_CHECKING:
    from drivers.bench import Bench, BenchKind


@dataclass(frozen=True)
class LoadedConfig:
    """A valid configuration and where it came from.

    Parameters
    ----------
    config
        All sections, defaults filled in.
    path
        The file.
    rig_path
        The rig file; None for the bench's own rig.
    warnings
        Sentences for the operator about what is allowed but unwise.
    origins
        Where each field was set, ``line 7`` or ``override``; what is not listed is a default.
    """

    config: Config
    path: Path
    rig_path: Path | None
    warnings: tuple[str, ...] = ()
    origins: Mapping[FieldPath, str] = field(default_factory=dict, repr=False)

    @property
    def bench_kind(self) -> BenchKind:
        """The bench kind that the file names."""
        return self.config.bench.bench_kind

    @property
    def bench_settings(self) -> BaseModel:
        """The settings of the bench, an instance of ``bench_kind.settings``."""
        return self.config.bench.settings

    def effective_yaml(self, rig: Path | str | None = None) -> str:
        """Write the configuration with all defaults filled in, as YAML that `load_config` reads to the same.

        A comment beside each value says which line of the file set it, or that it is a default.

        Parameters
        ----------
        rig
            What to write for a rig file, such as ``rig.json`` where a copy will lie beside; None: its full path.
        """
        from ruamel.yaml import YAML
        from ruamel.yaml.representer import RoundTripRepresenter

        class Representer(RoundTripRepresenter):
            """Writes null as a word, and quotes texts with line breaks of any kind so that they come back."""

        Representer.add_representer(
            type(None), lambda representer, _: representer.represent_scalar("tag:yaml.org,2002:null", "null")
        )
        Representer.add_representer(
            str,
            lambda representer, text: representer.represent_scalar(
                "tag:yaml.org,2002:str", text, style='"' if text.splitlines() not in ([], [text]) else None
            ),
        )
        document = self.config.model_dump(mode="json")
        if self.rig_path is not None:
            document["rig"] = str(self.rig_path.resolve() if rig is None else rig)
        tree = _commented(document, (), self.origins)
        # Quoted, because a file name may hold a line break.
        name = json.dumps(str(self.path), ensure_ascii=False)
        tree.yaml_set_start_comment(f"Effective configuration; `line` is a line of {name}.")
        yaml = YAML()
        yaml.Representer = Representer
        yaml.width = 1 << 16
        text = io.StringIO()
        yaml.dump(tree, text)
        return text.getvalue()


def load_config(path: str | Path, overrides: Mapping[str, Any] | None = None) -> LoadedConfig:
    """Read a configuration.

    Parameters
    ----------
    path
        YAML file in UTF-8.
    overrides
        Values that replace those of the file, such as ``{"scan.method": "tps"}``.

    Raises
    ------
    ConfigError
        The file cannot be read or is wrong; all mistakes are told at once.

    Notes
    -----
    Bench settings are validated with the context ``{"folder": Path}``, the folder of the file, so that a bench
    kind can resolve relative paths.
    """
    path = Path(path)
    source = read_source(
        path, start="`bench:` and `kind: simulated` below it, or begin with a copy of configs/demo.yaml"
    )
    source.override(overrides or {})
    try:
        config = Config.model_validate(source.data, context={"folder": path.parent})
    except ValidationError as error:
        from scanner.config.explain import explain

        raise ConfigError.of(explain(error, source, schema_for(source.data))) from None
    return LoadedConfig(
        config=config,
        path=path,
        rig_path=None if config.rig is None else path.parent / config.rig,
        warnings=tuple(dict.fromkeys(_fine_fringes(config.scan, source))),
        origins={
            where: f"line {line}" if line else "override" for where, (line, _) in (source.keys | source.values).items()
        },
    )


def open_bench(loaded: LoadedConfig) -> AbstractContextManager[Bench]:
    """Open the bench of a configuration; leaving the context darkens the projector and closes the devices."""
    return loaded.bench_kind.open(loaded.bench_settings)


def _fine_fringes(scan: ScanSection, source: Source) -> Iterator[str]:
    for axis in scan.axes:
        path = scan.fringe_field(axis)
        for i, frequency in enumerate(scan.frequencies(axis) or ()):
            if path is not None and frequency > 1 / 4:
                what = f"a period of {1 / frequency:.3g} px; below 4 px the optics leave little contrast"
                yield source.problem(("scan", *path, i), what, "").sentence


def _commented(value: Any, path: FieldPath, origins: Mapping[FieldPath, str]) -> Any:
    """Make a tree for ruamel.yaml with a comment beside each value about where it was set."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, dict):
        tree = CommentedMap()
        for key, sub in value.items():
            tree[key] = _commented(sub, (*path, key), origins)
            if not isinstance(sub, dict) and not _holds_sections(sub):
                tree.yaml_add_eol_comment(origins.get((*path, key), "default"), key, column=36)
        return tree
    if isinstance(value, list):
        items = CommentedSeq(_commented(item, (*path, i), origins) for i, item in enumerate(value))
        if not _holds_sections(value):
            items.fa.set_flow_style()
        return items
    return value


def _holds_sections(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(item, dict | list) for item in value)
