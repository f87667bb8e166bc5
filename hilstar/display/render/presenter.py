"""The last pass: the levels of a renderer onto the window that its context belongs to."""

import math
from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
import numpy.typing as npt

from hilstar.basics.errors import MachineError
from hilstar.display.render.backend import ScreenView
from hilstar.display.render.context import is_software
from hilstar.display.render.driver import Driver
from hilstar.display.render.encoder import TABLE_WIDTH, build_program, set_uniforms
from hilstar.display.window.x11 import GL_LIBRARY, X11_LIBRARY

GL_DITHER = 0x0BD0
MAX_LEVELS = 2**16
TRIPLES_UNIT = 3  # after the textures of three primaries' levels
PRIMARIES = ((1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1))  # grey, then red, green and blue


def level_texture(
    context: moderngl.Context, levels: npt.NDArray[np.uint8 | np.uint16]
) -> moderngl.Texture:
    """A texture of levels (height, width) that no renderer made."""
    with context:
        texture = context.texture(
            levels.shape[::-1],
            1,
            np.ascontiguousarray(levels),
            dtype=f"u{levels.itemsize}",
            alignment=1,
        )
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture


def window_context() -> moderngl.Context:
    """The context of the window that is current in this thread. Raises MachineError with what to
    install.
    """
    try:
        settings: Any = {"libgl": GL_LIBRARY, "libx11": X11_LIBRARY}
        return moderngl.create_context(require=330, **settings)
    except Exception as error:  # moderngl and glcontext raise plain Exceptions here
        raise MachineError(
            f"the window's OpenGL is not there ({error}); install it: apt-get install libgl1"
        ) from error


def checked_triples(bits: int) -> npt.NDArray[np.uint16]:
    """Every code of grey and of each primary alone, (n, 3)."""
    codes = np.arange(2**bits, dtype=np.uint16)
    parts = [np.outer(codes, primaries) for primaries in PRIMARIES]
    return np.concatenate(parts).astype(np.uint16)


def drawn_codes(read: bytes, screen_px: tuple[int, int], bits: int) -> npt.NDArray[np.float32]:
    """The codes (height, width, 3), the top row first, of a buffer as GL reads it: float32 shares
    of white, row by row from the bottom.
    """
    width, height = screen_px
    shares = np.frombuffer(read, dtype=np.float32).reshape(height, width, 3)[::-1]
    return np.asarray(np.rint(shares * np.float32(2**bits - 1)))


def changed_codes(context: moderngl.Context, screen_px: tuple[int, int], bits: int) -> str:
    """Which codes the back buffer has otherwise than they were drawn; "" where every code of grey
    and each primary is there.

    All are drawn side by side and read back. It overwrites the back buffer, and swaps nothing.
    """
    triples = checked_triples(bits)
    width, height = screen_px
    pixels = np.arange(width * height, dtype=np.uint32)
    at_once = min(MAX_LEVELS, width * height)
    wrong = 0
    first = ""
    for part in np.array_split(triples, math.ceil(len(triples) / at_once)):
        levels = (pixels % len(part)).astype(np.uint16).reshape(height, width)
        texture = level_texture(context, levels)
        Presenter(texture, ScreenView(screen_px, screen_px, bits, triples=part)).present()
        # not around those: where a headless context's inner block ends, none is current
        with context:
            read = context.screen.read(viewport=(0, 0, width, height), components=3, dtype="f4")
            # moderngl asks for an attachment, which a window's back buffer has not, and reads on
            _ = context.error
            texture.release()
        drawn = drawn_codes(read, screen_px, bits)
        differ = (drawn != part[levels]).any(axis=-1)
        changed = np.unique(levels[differ])
        if len(changed) and not wrong:
            became = drawn[(levels == changed[0]) & differ][0].astype(int)
            wanted = part[changed[0]]
            first = f"{tuple(wanted.tolist())} as {tuple(became.tolist())}"
        wrong += len(changed)
    if wrong:
        return f"{wrong} of {len(triples)} codes are not drawn as they are, {first}"
    return ""


class Presenter:
    """Draws a texture of levels on the screen of its context; `table` has the codes of each level.

    With two others `beside` them the levels are the codes of red, and theirs those of green and
    blue.
    """

    def __init__(
        self,
        levels: moderngl.Texture,
        view: ScreenView,
        beside: Sequence[moderngl.Texture] = (),
    ) -> None:
        self._textures = [levels, *beside]
        self._ctx = levels.ctx
        self._view = view
        with self._ctx:
            self._driver = Driver(self._ctx)
            self._draws_wait = is_software(self._ctx)
            self._ctx.disable_direct(GL_DITHER)  # which GL begins with
            self._plain, self._aided = (self._build(aids) for aids in (False, True))
        self.set_triples(view.triples)

    def _build(self, aids: bool) -> tuple[moderngl.Program, moderngl.VertexArray]:
        """The program without or with crosshair, grid, blank and patch, for this orientation
        alone.
        """
        view = self._view
        orientation = self._view.orientation
        flips = {"FLIP_X": orientation.flip_x, "FLIP_Y": orientation.flip_y}
        is_rgb = len(self._textures) > 1
        wanted = flips | {"STEALING": view.triples is not None, "RGB": is_rgb, "AIDS": aids}
        defines = (
            f"QUARTER_TURNS {orientation.quarter_turns % 4}",
            *(name for name, is_set in wanted.items() if is_set),
        )
        program = build_program(self._ctx, "full.vert", "present.frag", defines)
        values: dict[str, Any] = {
            "levels": 0,
            "triples": TRIPLES_UNIT,
            "green_levels": 1,
            "blue_levels": 2,
            "white": float(2**view.bits - 1),
            "size_px": view.resolution_px,
            "screen_px": view.screen_px,
            "cross_px": (round(view.cross_px[0]), round(view.cross_px[1])),
        }
        set_uniforms(program, values)
        return program, self._ctx.vertex_array(program, [])

    def set_triples(self, triples: npt.NDArray[np.uint16] | None) -> None:
        """Use other codes for the same levels."""
        if triples is None:
            used = np.zeros((1, 3), dtype=np.uint16)
        else:
            used = triples
        rows = -(-len(used) // TABLE_WIDTH)
        padded = np.zeros((rows, TABLE_WIDTH, 3), dtype=np.uint16)
        padded.reshape(-1, 3)[: len(used)] = used
        with self._ctx:
            self.table = self._ctx.texture(
                (TABLE_WIDTH, rows), 3, padded.tobytes(), dtype="u2", alignment=2
            )
            self.table.filter = (moderngl.NEAREST, moderngl.NEAREST)

    def wait(self) -> None:
        """Wait until the last swap is done: a driver that queues swaps has to give the next back
        buffer for this pixel.

        (As Psychtoolbox does after a flip.)
        """
        with self._ctx:
            self._ctx.screen.use()
            self._driver.take_back_buffer()
            self._driver.wait()

    def present(
        self, overlay: int = 0, patch_code: int = 0, marker: tuple[int, int] = (0, 0)
    ) -> None:
        """Draw the last levels on the back buffer; see `Backend.present`."""
        with self._ctx:
            screen = self._ctx.screen
            screen.use()
            # llvmpipe's, with the lock held, for the passes that write the levels
            if self._draws_wait:
                self._driver.wait()
            else:
                self._driver.take_back_buffer()
            self._ctx.viewport = (0, 0, *self._view.screen_px)
            for unit, texture in enumerate(self._textures):
                texture.use(unit)
            self.table.use(TRIPLES_UNIT)
            program, vao = self._aided if overlay else self._plain
            if overlay:
                program["overlay"], program["patch_code"] = overlay, patch_code
            vao.render(moderngl.TRIANGLES, vertices=3)
            side_px, code = marker
            if side_px:
                light = code / (2**self._view.bits - 1)
                screen.clear(light, light, light, 1.0, viewport=(0, 0, side_px, side_px))
            self._driver.wait()
