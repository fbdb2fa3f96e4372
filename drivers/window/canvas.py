"""Pictures on the graphics card, drawn grey value by grey value, pixel by pixel."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pyglet import gl
from pyglet.graphics.shader import Shader, ShaderProgram
from pyglet.graphics.vertexarray import VertexArray

from drivers.errors import DeviceSettingError
from drivers.window.settings import SyncPatch

Picture = NDArray[np.uint8]

# One triangle that holds the whole screen; its corners follow from their numbers.
_VERTEX = """
#version 330 core
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(corner, 0.0, 1.0);
}
"""
# Fetching the very texel leaves nothing to filters; OpenGL counts rows from below.
_FRAGMENT = """
#version 330 core
uniform sampler2D picture;
uniform int height;
out vec4 colour;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    colour = texelFetch(picture, ivec2(pixel.x, height - 1 - pixel.y), 0);
}
"""
_CHANNELS = ("red", "green", "blue")


class Canvas:
    """Draws loaded pictures into the back buffer of the current OpenGL context.

    Parameters
    ----------
    width, height
        Of the frame buffer, and of every picture, px.
    channels
        ``grey`` for all, or the one that grey pictures go to.
    patch
        Rectangle that `draw` paints over the picture.

    Raises
    ------
    DeviceSettingError
        What is drawn is not bit for bit what was given.
    """

    def __init__(self, width: int, height: int, channels: str, patch: SyncPatch | None) -> None:
        self._size = width, height
        self._lit = tuple(channels in ("grey", name) for name in _CHANNELS)
        self._patch = patch
        self._program = ShaderProgram(Shader(_VERTEX, "vertex"), Shader(_FRAGMENT, "fragment"))
        self._program.use()
        self._program["height"] = height
        self._vertices = VertexArray()
        self._vertices.bind()
        # What could stand between a grey value and the frame buffer.
        for feature in (gl.GL_DITHER, gl.GL_FRAMEBUFFER_SRGB, gl.GL_BLEND, gl.GL_MULTISAMPLE, gl.GL_DEPTH_TEST):
            gl.glDisable(feature)
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        gl.glViewport(0, 0, width, height)
        self._textures: list[int] = []
        self._check_exact()

    @property
    def loaded(self) -> int:
        """How many pictures there are."""
        return len(self._textures)

    @staticmethod
    def renderer() -> str:
        """Who draws: the graphics driver's own name and version."""
        return " ".join(_text(name) for name in (gl.GL_RENDERER, gl.GL_VERSION))

    def load(self, pictures: Sequence[Picture]) -> None:
        """Take over more pictures.

        Parameters
        ----------
        pictures
            Each (height, width) grey or (height, width, 3) red, green, blue; C-contiguous.

        Raises
        ------
        DeviceSettingError
            The graphics card has no room for them.
        """
        gl.glGetError()
        gl.glEnable(gl.GL_SCISSOR_TEST)
        gl.glScissor(0, 0, 1, 1)
        for picture in pictures:
            self._textures.append(self._texture(picture))
            # Some drivers upload when a texture is drawn first; that must not be when it is shown.
            self._paint(len(self._textures) - 1)
        gl.glDisable(gl.GL_SCISSOR_TEST)
        gl.glFinish()
        if (error := gl.glGetError()) != gl.GL_NO_ERROR:
            raise DeviceSettingError(
                f"projector window: the graphics card did not take {len(self._textures)} pictures (OpenGL error "
                f"0x{error:x})",
                "Load shorter sequences, or close other programs that use the graphics card.",
            )

    def _texture(self, picture: Picture) -> int:
        name = gl.GLuint()
        gl.glGenTextures(1, name)
        gl.glBindTexture(gl.GL_TEXTURE_2D, name)
        for parameter in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, parameter, gl.GL_NEAREST)
        gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_MAX_LEVEL, 0)
        kept, given = (gl.GL_R8, gl.GL_RED) if picture.ndim == 2 else (gl.GL_RGB8, gl.GL_RGB)
        if picture.ndim == 2:
            sources = [gl.GL_RED if lit else gl.GL_ZERO for lit in self._lit]
            gl.glTexParameteriv(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_SWIZZLE_RGBA, (gl.GLint * 4)(*sources, gl.GL_ONE))
        width, height = self._size
        pixels = picture.ctypes.data
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, kept, width, height, 0, given, gl.GL_UNSIGNED_BYTE, pixels)
        return int(name.value)

    def clear(self) -> None:
        """Forget all pictures."""
        if self._textures:
            gl.glDeleteTextures(len(self._textures), (gl.GLuint * len(self._textures))(*self._textures))
        self._textures = []

    def draw(self, index: int | None, *, patch_white: bool = False) -> None:
        """Draw picture ``index``, or black for None, and the patch above it."""
        if index is None:
            self._fill(0.0)
            return
        self._paint(index)
        if self._patch is not None:
            patch, height = self._patch, self._size[1]
            gl.glEnable(gl.GL_SCISSOR_TEST)
            gl.glScissor(patch.x_px, height - patch.y_px - patch.height_px, patch.width_px, patch.height_px)
            self._fill(float(patch_white))
            gl.glDisable(gl.GL_SCISSOR_TEST)

    def _paint(self, index: int) -> None:
        gl.glBindTexture(gl.GL_TEXTURE_2D, self._textures[index])
        gl.glDrawArrays(gl.GL_TRIANGLES, 0, 3)

    def _fill(self, value: float) -> None:
        red, green, blue = (value * lit for lit in self._lit)
        gl.glClearColor(red, green, blue, 1.0)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT)

    def read(self) -> Picture:
        """What is in the back buffer (height, width, 3)."""
        width, height = self._size
        pixels = np.empty((height, width, 3), np.uint8)
        gl.glReadBuffer(gl.GL_BACK)
        gl.glReadPixels(0, 0, width, height, gl.GL_RGB, gl.GL_UNSIGNED_BYTE, pixels.ctypes.data)
        return pixels[::-1]

    def _check_exact(self) -> None:
        width, height = self._size
        # Every grey value, and neighbours that differ in both directions: a shift or a filter would show.
        picture = ((7 * np.arange(width) + 11 * np.arange(height)[:, None]) % 256).astype(np.uint8)
        self.load([np.repeat(picture[..., None], 3, axis=2)])
        self._paint(0)
        wrong = np.count_nonzero((self.read() != picture[..., None]).any(axis=2))
        self.clear()
        if wrong:
            raise DeviceSettingError(
                f"projector window: {wrong} of {width * height} pixels are not drawn as given by {self.renderer()}",
                "Switch off anti-aliasing and image enhancement forced in the graphics driver's settings.",
            )


def _text(name: int) -> str:
    return ctypes.cast(gl.glGetString(name), ctypes.c_char_p).value.decode(errors="replace")  # type: ignore[union-attr]
