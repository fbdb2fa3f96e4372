"""The scenes a simulated bench can look at, parametric in pose, size, reflectance and roughness.

Every scene has its own frame (x right, y down, z away from the camera), whose origin and turn `Pose` gives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from sim_backend.scenes.artefacts import BallBarScene
from sim_backend.scenes.boards import BoardScene
from sim_backend.scenes.mirrors import MirrorRemovedScene, MirrorScene, SphereMirrorScene
from sim_backend.scenes.pose import Finish, Pose
from sim_backend.scenes.shapes import PlaneScene, SphereScene, StepsScene, VGrooveScene

__all__ = [
    "BallBarScene",
    "BoardScene",
    "Finish",
    "MirrorRemovedScene",
    "MirrorScene",
    "PlaneScene",
    "Pose",
    "Scene",
    "SphereMirrorScene",
    "SphereScene",
    "StepsScene",
    "VGrooveScene",
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
    | BoardScene,
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
