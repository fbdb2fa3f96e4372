"""What an operator says about a projector that is driven as a screen."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class SyncPatch(BaseModel):
    """A rectangle of the picture that a light sensor looks at, px from the upper left corner.

    While a sequence plays it is white in picture 0, 2, 4 …, black in 1, 3, 5 …, and black otherwise, so that every
    picture begins with an edge and the first one with a rising edge. It replaces what the pattern has there.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    x_px: int = Field(ge=0, description="Left edge, px.")
    y_px: int = Field(ge=0, description="Upper edge, px.")
    width_px: int = Field(gt=0, description="Width, px.")
    height_px: int = Field(gt=0, description="Height, px.")


class WindowSettings(BaseModel):
    """A projector at HDMI, DisplayPort or the like, showing a window that fills its screen."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    driver: Literal["window"] = "window"
    width_px: int = Field(
        gt=0, le=16384, description="The projector's own width, px; a screen in another mode is refused."
    )
    height_px: int = Field(gt=0, le=16384, description="The projector's own height, px.")
    screen: Annotated[int, Field(ge=0)] | str | None = Field(
        None,
        description="Number (from 0) or name of the screen, as `scan doctor` lists them; null takes the only one of "
        "the size width_px × height_px.",
    )
    display: str | None = Field(
        None, description="X display, such as :0 or :0.1 (its second X screen); null takes the one in DISPLAY."
    )
    fullscreen: bool = Field(
        True,
        description="Ask the window manager for a full screen. false lays a borderless window over the screen without "
        "asking; try it where the window manager puts the full screen in the wrong place.",
    )
    refresh_hz: float | None = Field(
        None, gt=1, le=1000, description="Refresh rate the screen must have, Hz; null accepts what the screen says."
    )
    channels: Literal["grey", "red", "green", "blue"] = Field(
        "grey", description="grey shows a pattern on all channels, a colour on that one alone, the others black."
    )
    hold: int = Field(1, ge=1, le=1000, description="For how many refreshes each picture of a played sequence is on.")
    pacing: Literal["vsync", "timer"] = Field(
        "vsync",
        description="vsync flips with the screen's refresh. timer flips at multiples of 1 / refresh_hz on the "
        "machine's monotonic clock; only for X servers without a refresh, such as a virtual one.",
    )
    timer_phase_ms: float = Field(
        0.0, ge=0, le=1000, description="How much later than the multiples of the period the timer flips, ms."
    )
    sync_patch: SyncPatch | None = Field(
        None, description="Rectangle that changes with every picture of a played sequence, for a light sensor."
    )
    timing_flips: int = Field(100, ge=20, le=1000, description="How many flips the check at the start is made of.")
    max_jitter_ms: float = Field(
        1.0, gt=0, description="Nine in ten flips of that check must come closer to the regular refresh than this, ms."
    )
    memory_limit_mib: int = Field(
        2048, ge=16, description="Largest loaded sequence, MiB; it is kept in the graphics card's memory."
    )

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.pacing == "timer" and self.refresh_hz is None:
            raise ValueError("pacing timer needs refresh_hz: such a screen has no rate of its own")
        patch = self.sync_patch
        if patch is not None and (
            patch.x_px + patch.width_px > self.width_px or patch.y_px + patch.height_px > self.height_px
        ):
            raise ValueError(f"sync_patch does not lie within the picture of {self.width_px} × {self.height_px} px")
        return self
