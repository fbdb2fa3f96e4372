"""The features of a camera by name: set, read back, and explained where the camera will not have it."""

from __future__ import annotations

import difflib
import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from drivers.errors import DeviceSettingError
from drivers.genicam.library import reason

Value = bool | int | float | str

_READABLE = (3, 4)  # EAccessMode: read only, read and write
_WRITABLE = (2, 4)  # write only, read and write
_ACCESS = {
    0: "this camera does not have it",
    1: "it is not available in the camera's present state",
    2: "it can only be written",
    3: "it is read only, or locked in the camera's present state",
}
_VALUES = ("IInteger", "IFloat", "IBoolean", "IEnumeration", "IString")
_UNDECLARED_STEP = 0.01  # of the value, where the camera does not say in which steps it can be set
_COMMAND_TIMEOUT_S = 5.0


@dataclass
class Features:
    """The features of one camera.

    Parameters
    ----------
    device
        The name that errors mention.
    node_map
        The camera's ``genicam.genapi.NodeMap``.
    """

    device: str
    node_map: Any
    rounded: dict[str, tuple[Value, Value]] = field(default_factory=dict, init=False)
    """What was asked for and what the camera made of it, where these are not the same."""

    def first(self, *names: str) -> str | None:
        """The first of several names, standard and old, that this camera has; None where it has none."""
        return next((name for name in names if self._access(name) > 1), None)

    def read(self, name: str) -> Any:
        """The value of a feature that is there."""
        return self.node_map.get_node(name).value

    def greatest(self, name: str) -> Any:
        """The greatest value that a number can be set to now."""
        return self.node_map.get_node(name).max

    def entries(self, name: str) -> tuple[str, ...]:
        """What an enumeration can be set to now; empty where it is none or is not there."""
        node = self._node(name)
        return tuple(node.symbolics) if self._kind(node) == "IEnumeration" and self._access(name) > 1 else ()

    def limits(self, name: str) -> str:
        """What the camera says it takes, as a clause for an operator."""
        node = self._node(name)
        if self._kind(node) == "IEnumeration":
            return f"the camera takes {', '.join(self.entries(name)) or 'nothing'}"
        if self._kind(node) in ("IBoolean", "IString"):
            return f"the camera takes {'true or false' if self._kind(node) == 'IBoolean' else 'a text'}"
        unit = f" {node.unit}" if node.unit else ""
        step = self._step(node)
        steps = f" in steps of {step:.12g}" if step else ""
        return f"the camera takes {node.min:.12g} … {node.max:.12g}{unit}{steps}"

    def write(self, name: str, value: Value) -> Value:
        """Set a feature and read it back; a command is executed by the value True.

        Returns
        -------
        value
            What the camera has made of it.

        Raises
        ------
        DeviceSettingError
            The camera has no such feature, does not let it be written now, or does not take the value; the message
            quotes the camera's own limits.
        """
        from genicam import genapi

        node = self._writable(name)
        kind = self._kind(node)
        try:
            if kind == "ICommand":
                if value is not True:
                    raise self._refused(name, value, "it is a command, which is executed by the value true")
                self.execute(name)
                return True
            node.value = self._fitting(name, node, kind, value)
            made: Value = node.value if self._access(name) in _READABLE else value
        except genapi.GenericException as error:
            raise self._refused(name, value, f"{reason(error)}; {self.limits(name)}") from None
        if made != value:
            self._judge(name, node, value, made)
        return made

    def write_if_there(self, names: Iterable[str], value: Value) -> None:
        """Set the first of ``names`` that can be set to ``value``; nothing where none can."""
        for name in names:
            if self._access(name) in _WRITABLE and (not self.entries(name) or value in self.entries(name)):
                self.write(name, value)
                return

    def execute(self, name: str) -> None:
        """Execute a command and wait until the camera has done it.

        Raises
        ------
        DeviceSettingError
            The camera does not have it, or does not finish it.
        """
        node = self._writable(name)
        node.execute()
        deadline = time.monotonic() + _COMMAND_TIMEOUT_S
        while not node.is_done():
            if time.monotonic() > deadline:
                raise DeviceSettingError(
                    f"{self.device}: the command {name} is not done after {_COMMAND_TIMEOUT_S:g} s",
                    "Switch the camera off and on again.",
                )
            time.sleep(0.001)

    def automatics(self) -> list[str]:
        """Names of all features that let the camera decide by itself, such as ExposureAuto, and can be switched off."""
        names = (node.node.name for node in self.node_map.nodes if node.node.is_feature())
        return [n for n in names if n.endswith("Auto") and "Off" in self.entries(n) and self._access(n) in _WRITABLE]

    def snapshot(self) -> dict[str, Value]:
        """All features that can be read, by name; of those with a selector, the selected one."""
        from genicam import genapi

        values: dict[str, Value] = {}
        for node in self.node_map.nodes:
            if not node.node.is_feature() or self._kind(node) not in _VALUES:
                continue
            if node.get_access_mode() not in _READABLE:
                continue
            try:
                values[node.node.name] = node.value
            except genapi.GenericException:
                continue  # says it can be read, and cannot
        return {name: str(v) if isinstance(v, float) and not math.isfinite(v) else v for name, v in values.items()}

    def _node(self, name: str) -> Any:
        from genicam import genapi

        try:
            return self.node_map.get_node(name)
        except genapi.GenericException:
            return None

    def _access(self, name: str) -> int:
        node = self._node(name)
        return 0 if node is None else int(node.get_access_mode())

    def _writable(self, name: str) -> Any:
        node = self._node(name)
        if node is None or not node.node.is_feature():
            known = [n.node.name for n in self.node_map.nodes if n.node.is_feature()]
            near = difflib.get_close_matches(name, known, 4, 0.6)
            raise DeviceSettingError(
                f"{self.device} has no feature {name}" + (f"; near: {', '.join(near)}" if near else ""),
                "Write the name as the camera's manual does; it depends on the camera's model which there are.",
            )
        access = self._access(name)
        if access not in _WRITABLE:
            now = f" (it is {node.value})" if access in _READABLE and self._kind(node) in _VALUES else ""
            raise DeviceSettingError(
                f"{self.device}: {name} cannot be set: {_ACCESS[access]}{now}",
                "Take it out of the bench file, or set first what it depends on (its selector or mode): features are "
                "set in the order of the file.",
            )
        return node

    def _fitting(self, name: str, node: Any, kind: str, value: Value) -> Value:
        """``value`` in the type of the feature; refused where the camera would round or clip it silently."""
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if kind in ("IInteger", "IFloat"):
            if not number or (kind == "IInteger" and value != int(value)):
                raise self._refused(name, value, self.limits(name))
            if not node.min <= value <= node.max:
                raise self._refused(name, value, self.limits(name))
            return int(value) if kind == "IInteger" else float(value)
        fits = {"IBoolean": isinstance(value, bool), "IString": isinstance(value, str)}
        if kind == "IEnumeration":
            fits[kind] = value in self.entries(name)
        if not fits.get(kind, False):
            raise self._refused(name, value, self.limits(name) if kind in fits else "it holds no single value")
        return value

    def _judge(self, name: str, node: Any, asked: Value, made: Value) -> None:
        numbers = isinstance(asked, int | float) and isinstance(made, int | float)
        if not numbers or abs(float(made) - float(asked)) >= (self._step(node) or _UNDECLARED_STEP * abs(float(asked))):
            raise self._refused(name, asked, f"the camera made {made} of it; {self.limits(name)}")
        self.rounded[name] = (asked, made)

    def _refused(self, name: str, value: Value, why: str) -> DeviceSettingError:
        return DeviceSettingError(
            f"{self.device}: {name} cannot be {value}: {why}", f"Set {name} to a value that the camera takes."
        )

    @staticmethod
    def _kind(node: Any) -> str:
        return type(node).__name__

    @staticmethod
    def _step(node: Any) -> float:
        """The declared increment, 0 where there is none."""
        if hasattr(node, "has_inc") and not node.has_inc():
            return 0.0
        return float(node.inc)
