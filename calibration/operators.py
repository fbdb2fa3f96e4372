"""Who holds boards and places artefacts: a person, led by pictures or words, or a script before a simulated bench."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Protocol

import numpy as np

from calibration.boards import Board
from calibration.guide.guidance import Bar, Curve, Step
from calibration.observations import BoardPose
from calibration.settings import HandSettings
from drivers import Bench, OperatorError, Presenter
from scanner.rig import Lens


class Answer(StrEnum):
    """What the operator wants."""

    TAKE = "take"
    SKIP = "skip"
    BACK = "back"
    """Take the last pose again."""
    STOP = "stop"
    """Leave now, go on another day."""


class UnattendedError(OperatorError):
    """Something needs a hand, and there is none."""


class StoppedError(OperatorError):
    """The operator has left; everything that was taken is kept."""

    exit_code = 130


def stopped(what: str = "stopped by the operator") -> StoppedError:
    """The error of an operator who leaves for now."""
    return StoppedError(what, "Everything so far is kept; the same command goes on from here.")


@dataclass(frozen=True)
class Request:
    """What the operator is asked to hold, and why there.

    Parameters
    ----------
    step
        Of the calibration.
    title
        Such as ``pose 4 of 10``.
    instruction
        What to do, in one sentence.
    pose
        Where.
    exact
        Whether it matters that the board is held just there; otherwise it is enough that it is seen.
    reason
        What is gained by it.
    bars
        How well is known by now what the step is to find.
    lens
        The camera's, as it is known by now.
    """

    step: Step
    title: str
    instruction: str
    pose: BoardPose
    exact: bool = False
    reason: str = ""
    bars: tuple[Bar, ...] = ()
    lens: Lens | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a step has found, for the operator to look at.

    Parameters
    ----------
    step
        Of the calibration.
    text
        The figures in words.
    notes
        Warnings, each with what to do.
    curve
        What was measured.
    bars
        How well is known what was to be found.
    """

    step: Step
    text: str
    notes: tuple[str, ...] = ()
    curve: Curve | None = None
    bars: tuple[Bar, ...] = ()


class Operator(Protocol):
    """Does by hand what a calibration asks for, and is told how it goes."""

    def hold_board(self, bench: Bench, board: Board, request: Request) -> Answer:
        """Have the board held before the bench; returns when it stands still there, or the operator wants else."""
        ...

    def keep(self, bench: Bench) -> None:
        """Leave what is held where it is, before the bench that was opened anew."""
        ...

    def place(self, bench: Bench, what: str, scene: Mapping[str, Any]) -> Answer:
        """Have an artefact placed: ``what`` says how, ``scene`` is the document for a `drivers.Presenter`."""
        ...

    def wait(self, what: str, done: int, total: int) -> None:
        """Be told that ``done`` of ``total`` are through, ``what`` in words; nothing may move meanwhile.

        Raises
        ------
        StoppedError
            The operator has left.
        """
        ...

    def tell(self, good: bool, text: str) -> None:
        """Be told whether what was just taken counts."""
        ...

    def learn(self, outcome: Outcome) -> None:
        """Look at what a step has found; returns when the operator has seen it.

        Raises
        ------
        StoppedError
            The operator has left.
        """
        ...

    def again(self, step: Step, error: OperatorError, what: str) -> bool:
        """Whether, after a step failed, the operator has mended it and wants ``what``; nobody does without a person."""
        ...


@dataclass
class ScriptedOperator:
    """Nobody: a bench that presents things itself gets them presented, about where they are asked for.

    Parameters
    ----------
    hand
        How far off.
    """

    hand: HandSettings

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.hand.seed)
        self._held: Mapping[str, Any] = {}

    def hold_board(self, bench: Bench, board: Board, request: Request) -> Answer:
        """Present the board a little off the pose that was asked for."""
        mm = self._random.normal(0, self.hand.error_mm, 3)
        deg = self._random.normal(0, self.hand.error_deg, 3)
        pose = request.pose
        held = replace(
            pose,
            distance_mm=pose.distance_mm + mm[2],
            offset_x_mm=pose.offset_x_mm + mm[0],
            offset_y_mm=pose.offset_y_mm + mm[1],
            yaw_deg=pose.yaw_deg + deg[0],
            pitch_deg=pose.pitch_deg + deg[1],
            roll_deg=pose.roll_deg + deg[2],
        )
        return self.place(bench, board.name, board.scene(held))

    def keep(self, bench: Bench) -> None:
        """Present the same once more."""
        _presenter(bench).present(self._held)

    def place(self, bench: Bench, what: str, scene: Mapping[str, Any]) -> Answer:
        """Present the artefact exactly there."""
        self._held = scene
        self.keep(bench)
        return Answer.TAKE

    def wait(self, what: str, done: int, total: int) -> None:
        """Nobody waits."""

    def tell(self, good: bool, text: str) -> None:
        """Nobody listens; the terminal has said it."""

    def learn(self, outcome: Outcome) -> None:
        """Nobody looks."""

    def again(self, step: Step, error: OperatorError, what: str) -> bool:
        """Nobody mends anything."""
        return False


def _presenter(bench: Bench) -> Presenter:
    if not isinstance(bench, Presenter):
        raise UnattendedError(
            f"bench {bench.name} has nobody who holds things before it",
            "Run `calibrate` without --headless: it leads you through the steps.",
        )
    return bench


def wording(pose: BoardPose) -> str:
    """Where to hold the board, for somebody who stands before the bench and looks towards it."""
    return f"Hold the board {whereabouts(pose)}."


def whereabouts(pose: BoardPose) -> str:
    """A pose in words."""
    turns = []
    if abs(pose.yaw_deg) >= 5:
        turns.append(f"{'left' if pose.yaw_deg < 0 else 'right'} edge {abs(pose.yaw_deg):.0f}° towards the camera")
    if abs(pose.pitch_deg) >= 5:
        turns.append(f"{'upper' if pose.pitch_deg > 0 else 'lower'} edge {abs(pose.pitch_deg):.0f}° towards the camera")
    if abs(pose.roll_deg) >= 5:
        turns.append(f"turned by {abs(pose.roll_deg):.0f}° {'clockwise' if pose.roll_deg > 0 else 'anticlockwise'}")
    where = [
        f"{abs(off):.0f} mm {name}"
        for off, name in (
            (pose.offset_x_mm, "right" if pose.offset_x_mm > 0 else "left"),
            (pose.offset_y_mm, "low" if pose.offset_y_mm > 0 else "high"),
        )
        if abs(off) >= 10
    ]
    place = f"{pose.distance_mm / 10:.0f} cm from the camera" + (
        f", {' and '.join(where)} in its picture" if where else ""
    )
    return f"{place}; {', '.join(turns) if turns else 'facing the camera'}"
