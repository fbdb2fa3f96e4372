"""The scenes a simulated bench can look at, parametric in pose, size, reflectance and roughness.

Every scene has its own frame (x right, y down, z away from the camera), whose origin and turn `Pose` gives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from sim_backend.scenes.artefacts import BallBarScene
from sim_backend.scenes.beside_mirror import (
    EdgeMirrorScene,
    EpipolarMirrorScene,
    MirrorChainScene,
    PolishedScene,
    TexturedMirrorScene,
    TranslucentMirrorScene,
)
from sim_backend.scenes.boards import BoardScene
from sim_backend.scenes.glossy import FinsScene, VBoardSphereScene
from sim_backend.scenes.industrial import PartScene, Piece
from sim_backend.scenes.matt_objects import ObjectsScene
from sim_backend.scenes.mirrors import MirrorRemovedScene, MirrorScene, SphereMirrorScene
from sim_backend.scenes.pose import Finish, Pose
from sim_backend.scenes.shapes import PlaneScene, SphereScene, StepsScene, VGrooveScene
from sim_backend.scenes.windows import Window

__all__ = [
    "BallBarScene",
    "BoardScene",
    "EdgeMirrorScene",
    "EpipolarMirrorScene",
    "Finish",
    "FinsScene",
    "MirrorChainScene",
    "MirrorRemovedScene",
    "MirrorScene",
    "ObjectsScene",
    "PartScene",
    "Piece",
    "PlaneScene",
    "PolishedScene",
    "Pose",
    "Scene",
    "SphereMirrorScene",
    "SphereScene",
    "StepsScene",
    "TexturedMirrorScene",
    "TranslucentMirrorScene",
    "VBoardSphereScene",
    "VGrooveScene",
    "Window",
    "scene_of",
]

Scene = Annotated[
    PlaneScene
    | SphereScene
    | StepsScene
    | VGrooveScene
    | MirrorScene
    | MirrorRemovedScene
    | SphereMirrorScene
    | BallBarScene
    | BoardScene
    | VBoardSphereScene
    | ObjectsScene
    | EpipolarMirrorScene
    | TexturedMirrorScene
    | EdgeMirrorScene
    | TranslucentMirrorScene
    | PolishedScene
    | MirrorChainScene
    | FinsScene
    | PartScene,
    Field(discriminator="name"),
]
"""Any of the scenes, told apart by ``name``."""

_any_scene: TypeAdapter[Scene] = TypeAdapter(Scene)


def scene_of(document: Mapping[str, Any]) -> Scene:
    """The scene that a JSON document describes.

    Raises
    ------
    pydantic.ValidationError
        It describes none.
    """
    return _any_scene.validate_python(dict(document))
