"""Calibrations of random simulated rigs, picture by picture, and how far they are from the truth."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.acceptance import PlaneArtefact, SphereArtefact
from calibration.acceptance.evaluation import evaluate
from calibration.boards import Board, Chessboard
from calibration.bundle import calibrate_rig
from calibration.capture import Occasion, capture_fringes
from calibration.correspondence import observe
from calibration.detection import BoardNotFoundError, find_board
from calibration.observations import BoardPose, PoseObservation
from calibration.photometry import response_of_ramp, take_ramp
from calibration.planning import first_poses, grid, next_pose
from calibration.solver.parameters import DISTORTION
from calibration.solver.result import COVERAGE_95, Calibration
from drivers import NoiseModel
from scanner.acquisition import Silence
from scanner.config import ScanSection
from scanner.response import ProjectorResponse
from scanner.result import Maps
from scanner.rig import Rig
from scanner.triangulation import triangulate
from sim_backend.bench import kind
from sim_backend.scenes import PlaneScene
from sim_backend.settings import SimulatedSettings
from sim_backend.stage import SimulatedBench

BOARD = Chessboard(columns=12, rows=9, square_mm=15.0, margin_mm=12.0)
POSES, BEGINNING = 10, 4
TILT_DEG = 30.0
HAND_MM, HAND_DEG = 3.0, 2.0  # nobody holds a board exactly where it is asked for
RAMP = tuple(range(0, 256, 15))


def random_settings(rng: np.random.Generator, gamma: float = 2.2, shrink: int = 1) -> SimulatedSettings:
    """A bench with random lenses and a random place of its projector; pictures of 1/``shrink`` of the usual size."""

    def lens(width: int, height: int, fov: tuple[float, float], shift_px: float) -> dict[str, object]:
        k1, k2 = rng.uniform(-0.15, 0.1), rng.uniform(-0.1, 0.2)
        p1, p2 = rng.normal(0, 5e-4, 2)
        return {
            "width_px": width // shrink,
            "height_px": height // shrink,
            "field_of_view_deg": rng.uniform(*fov),
            "principal_offset_px": tuple(rng.normal(0, shift_px / shrink, 2)),
            "distortion_k1": k1,
            "distortion_k2": k2,
            "distortion_p1": p1,
            "distortion_p2": p2,
        }

    return SimulatedSettings.model_validate(
        {
            "camera": {**lens(1024, 768, (26, 32), 12), "white_dn": 150.0, "read_noise_dn": 1.5},
            "projector": {**lens(1280, 800, (32, 39), 25), "gamma": gamma},
            "baseline_mm": rng.uniform(150, 210),
            "convergence_mm": rng.uniform(570, 650),
            "projector_roll_deg": rng.normal(0, 2),
            "projector_height_mm": rng.normal(0, 15),
            "seed": int(rng.integers(2**31)),
            "knows_rig": False,
            "transport": {"supersample": 2},
        }
    )


def fringes(settings: SimulatedSettings, steps: int = 6) -> ScanSection:
    """Two axes, three periods each."""
    size = settings.projector.width_px, settings.projector.height_px
    periods = {axis: [16.0, 80.0, float(extent)] for axis, extent in zip("xy", size, strict=True)}
    return ScanSection(method="tps", steps=steps, periods_px=periods)


def nominal(settings: SimulatedSettings) -> Rig:
    """What a data sheet says of the lenses: the fields of view, and nothing else."""
    rig = settings.rig()
    plain = [replace(lens, distortion=np.zeros(5)) for lens in (rig.camera, rig.projector)]
    return replace(rig, camera=plain[0], projector=plain[1])


@dataclass(frozen=True)
class Seen:
    """Decoded fringes on something, and the noise of a frame at its bright places."""

    maps: Maps
    noise_dn: float
    frames: int


class Simulated:
    """An open bench on which things are presented and photographed."""

    def __init__(self, bench: SimulatedBench, scan: ScanSection, response: ProjectorResponse | None = None) -> None:
        self.bench, self.scan, self.response = bench, scan, response

    @classmethod
    @contextmanager
    def of(cls, settings: SimulatedSettings, steps: int = 6) -> Iterator[Simulated]:
        with kind.open(settings) as bench:
            yield cls(bench, fringes(settings, steps))

    def measure_response(self) -> None:
        """By a ramp of grey levels on whatever stands there; patterns are corrected for it from now on."""
        self.response = response_of_ramp(take_ramp(self.bench, RAMP)).response

    def photograph(self) -> Seen:
        with tempfile.TemporaryDirectory() as folder:
            occasion = Occasion("geometry", {}, {})
            take = Path(folder) / "take"
            maps, noise = capture_fringes(self.bench, self.scan, self.response, take, occasion, Silence())
        return Seen(maps, noise_at(maps, noise), self.scan.steps * 6)

    def board(self, pose: BoardPose) -> Seen:
        self.bench.present(BOARD.scene(pose))
        return self.photograph()


def noise_at(maps: Maps, noise: NoiseModel) -> float:
    return math.sqrt(float(noise.variance(float(np.quantile(maps.brightness, 0.9)))))


def observed(name: str, seen: Seen, board: Board = BOARD) -> PoseObservation:
    """As the geometry step reads a pose."""
    maps = seen.maps
    view = find_board(maps.brightness, board, seen.noise_dn / math.sqrt(seen.frames))
    return observe(name, view, board, maps.x_p, maps.sigma_x, maps.y_p, maps.sigma_y, maps.modulation, maps.valid)


def asked(settings: SimulatedSettings, poses: list[PoseObservation]) -> BoardPose:
    """Where the wizard wants the board next: a fixed scheme first, then where it lowers the uncertainty most."""
    guess = nominal(settings)
    middle = settings.convergence_mm
    if len(poses) < BEGINNING:
        scheme = first_poses(guess.camera, BOARD.points)
        wanted = scheme[len(poses) % len(scheme)]
    else:
        calibration = calibrate_rig(poses, guess.camera.size, guess.projector.size)
        pool = [within(pose, middle) for pose in grid(calibration.rig.camera, BOARD.points, middle)]
        found = next_pose(calibration, BOARD.points, pool)
        assert found is not None
        wanted = found.pose
    return within(wanted, middle)


def within(pose: BoardPose, middle_mm: float) -> BoardPose:
    """Bring a pose into the working volume along its line of sight."""
    distance = float(np.clip(pose.distance_mm, 0.92 * middle_mm, 1.2 * middle_mm))
    ratio = distance / pose.distance_mm
    turned = min(1.0, TILT_DEG / max(abs(pose.yaw_deg), abs(pose.pitch_deg), 1e-9))
    return replace(
        pose,
        distance_mm=distance,
        offset_x_mm=pose.offset_x_mm * ratio,
        offset_y_mm=pose.offset_y_mm * ratio,
        yaw_deg=pose.yaw_deg * turned,
        pitch_deg=pose.pitch_deg * turned,
    )


def held(pose: BoardPose, rng: np.random.Generator) -> BoardPose:
    """A pose as a hand holds it."""
    x, y, z = rng.normal(0, HAND_MM, 3)
    yaw, pitch, roll = rng.normal(0, HAND_DEG, 3)
    return BoardPose(
        pose.distance_mm + z,
        pose.offset_x_mm + x,
        pose.offset_y_mm + y,
        pose.yaw_deg + yaw,
        pose.pitch_deg + pitch,
        pose.roll_deg + roll,
    )


def truth(rig: Rig) -> dict[str, float]:
    """Parameters by the names of `calibration.solver.parameters.NAMES`, but for the rotation."""
    out = {}
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        K, terms = lens.matrix, np.pad(lens.distortion, (0, len(DISTORTION) - len(lens.distortion)))
        out |= {f"{name}.fx": K[0, 0], f"{name}.fy": K[1, 1], f"{name}.cx": K[0, 2], f"{name}.cy": K[1, 2]}
        out |= {f"{name}.{term}": float(value) for term, value in zip(DISTORTION, terms, strict=True)}
    return out | {f"translation.{axis}": value for axis, value in zip("xyz", rig.translation, strict=True)}


def in_sigmas(found: Calibration, true_rig: Rig) -> dict[str, float]:
    """Errors of all parameters over their standard uncertainties."""
    true = truth(true_rig)
    out = {n: (found.value(n)[0] - true[n]) / found.value(n)[1] for n in found.names if n in true}
    # `cv2.Rodrigues` takes turns below 1e-5 rad for none.
    turn = Rotation.from_matrix(found.rig.rotation @ true_rig.rotation.T).as_rotvec()
    out |= {f"rotation.{axis}": turn[i] / found.value(f"rotation.{axis}")[1] for i, axis in enumerate("xyz")}
    out["baseline"] = (found.baseline[0] - np.linalg.norm(true_rig.translation)) / found.baseline[1]
    return {name: float(value) for name, value in out.items()}


def figures(found: Calibration, true_rig: Rig) -> dict[str, float]:
    """Relative errors of focal lengths and baseline, reprojection errors over what noise predicts, share of intervals.

    Focal lengths count along x and y, whichever is worse.
    """
    camera, projector = (
        float(np.abs(np.diag(one.matrix)[:2] / np.diag(other.matrix)[:2] - 1).max())
        for one, other in ((found.rig.camera, true_rig.camera), (found.rig.projector, true_rig.projector))
    )
    errors = in_sigmas(found, true_rig)
    return {
        "camera": camera,
        "projector": projector,
        "baseline": found.baseline[0] / float(np.linalg.norm(true_rig.translation)) - 1,
        "rms_camera": found.rms_camera,
        "rms_projector": found.rms_projector,
        "ratio_camera": found.rms_camera / found.expected_camera,
        "ratio_projector": found.rms_projector / found.expected_projector,
        "inside": float(np.mean([abs(z) < COVERAGE_95 for z in errors.values()])),
        "spread": float(np.sqrt(np.mean(np.square(list(errors.values()))))),
    }


def triangulated(maps: Maps, rig: Rig) -> Maps:
    """The maps with points by another rig."""
    found = triangulate(rig, maps.x_p, maps.sigma_x, maps.y_p, maps.sigma_y)
    return replace(
        maps,
        points=found.points,
        depth=found.depth,
        sigma_point=found.sigma_point,
        epipolar_px=found.epipolar_px,
    )


def calibrated(
    bench: Simulated, settings: SimulatedSettings, rng: np.random.Generator, poses: int = POSES
) -> Calibration:
    """Hold the board until it was found in as many poses, as the wizard does, and solve."""
    found: list[PoseObservation] = []
    for _ in range(2 * poses):
        seen = bench.board(held(asked(settings, found), rng))
        with suppress(BoardNotFoundError):
            found.append(observed(f"pose {len(found) + 1}", seen))
        if len(found) == poses:
            break
    rig = settings.rig()
    return calibrate_rig(found, rig.camera.size, rig.projector.size)


def accepted(bench: Simulated, found: Rig, settings: SimulatedSettings) -> dict[str, tuple[float, float]]:
    """Figures (mm) of a plane and a sphere by the rig that was found and by the true one, from the same frames."""
    out = {}
    pose = BoardPose(settings.convergence_mm, yaw_deg=12, pitch_deg=-6)
    for artefact in (PlaneArtefact(width_mm=220, height_mm=160), SphereArtefact(diameter_mm=120)):
        bench.bench.present(artefact.scene(pose))
        maps = bench.photograph().maps
        pair = [
            evaluate(artefact, [triangulated(maps, rig)], rig, np.random.default_rng(0)).figures
            for rig in (found, settings.rig())
        ]
        for one, other in zip(*pair, strict=True):
            if one.value_mm is not None and other.value_mm is not None:
                out[one.quantity.name] = one.value_mm, other.value_mm
    return out


def studied(seed: int, folder: Path, with_artefacts: bool) -> dict[str, object]:
    """One random rig of the study, from its file where it was done before."""
    place = folder / f"rig-{seed:03d}.json"
    if place.is_file():
        return json.loads(place.read_text())
    rng = np.random.default_rng([4, seed])
    settings = random_settings(rng)
    wall = PlaneScene(width_mm=400, height_mm=300)
    with Simulated.of(settings.model_copy(update={"scene": wall})) as bench:
        bench.measure_response()
        found = calibrated(bench, settings, rng)
        result = {
            "seed": seed,
            "gamma": bench.response.gamma,
            **figures(found, settings.rig()),
            "in_sigmas": in_sigmas(found, settings.rig()),
            "findings": [finding.code for finding in found.findings],
            "artefacts": accepted(bench, found.rig, settings) if with_artefacts else {},
        }
    partial = place.with_suffix(".part")
    partial.write_text(json.dumps(result))
    partial.rename(place)
    return result
