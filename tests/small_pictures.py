"""Pictures of few pixels, where a command chooses their size or everywhere, and warps of few steps.

For tests of what commands take and write, here and in processes of their own; how pictures look and how well features
meet have tests of their own.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial

Put = Callable[[object, str, object], None]


def put_everywhere(put: Put, module: object, name: str, made: Callable) -> None:
    """Set a function of a module, and of the packages that find it there at first use and keep what they find."""
    import omtwarp
    from omtwarp import render, texturing

    for package in (omtwarp, render, texturing):
        if name in dir(package):
            put(package, name, made)
    put(module, name, made)


def shrink(put: Put = setattr) -> None:
    """Draw less for pages, the demo and films of registrations.

    Args:
        put: sets an attribute of a module; that of pytest's ``monkeypatch`` takes it back.
    """
    from omtwarp.cohort import page as cohort_page
    from omtwarp.render import films, pictures
    from omtwarp.reporting import page
    from omtwarp.shape_analysis import reports
    from omtwarp.texturing import atlas, textured

    def sized(module: object, name: str, size: tuple[int, int], **fixed: object) -> None:
        made = getattr(module, name)
        put(module, name, lambda *given, **options: made(*given, **options | {"size": size} | fixed))

    def least(*given: object) -> tuple[int, float]:
        return 64, sharp_size(*given)[1]

    rasterize, texture, sharp_size = page.rasterize, textured.texture, atlas.sharp_size
    put(films, "PROBE_WIDTH", 16)  # of pictures on which motion is measured
    put(page, "make_scene", partial(page.make_scene, texels=32))
    put(page, "rasterize", lambda pattern, width, **options: rasterize(pattern, min(width, 64), **options))
    put(atlas, "sharp_size", least)

    def small(*given: object, size: int | None = None, **options: object) -> object:
        return texture(*given, size=size or 64, **options)

    put_everywhere(put, textured, "texture", small)
    for module in (page, cohort_page, reports):
        sized(module, "preview", (48, 36))
    sized(reports, "film", (16, 16), seconds=0.2, fps=2, backend="warp")
    for name in ("preview", "comparison"):
        put_everywhere(put, pictures, name, partial(getattr(pictures, name), size=(48, 36)))


def shrink_all(put: Put = setattr) -> None:
    """Draw pictures and films of few pixels whatever size is asked for."""
    from omtwarp.render import films, pictures

    def sized(draws: Callable, size: tuple[int, int]) -> Callable:
        return lambda *given, **options: draws(*given, **options | {"size": size})

    shrink(put)
    for name in ("sheet", "preview"):
        put_everywhere(put, pictures, name, sized(getattr(pictures, name), (48, 36)))
    put_everywhere(put, films, "film", sized(films.film, (48, 48)))


def shorten(put: Put = setattr) -> None:
    """Warp features by one step at each of two levels, from one start, on a coarse grid."""
    warp, register, sides = (
        importlib.import_module(f"omtwarp.registration.{name}") for name in ("warp", "register", "sides")
    )
    put(warp, "ITERATIONS", 1)
    put(warp, "FEATURE_GRID", 8)
    put(warp, "MATCHED_GRID", 2)
    put(warp, "PLACES", 4)
    put(sides, "STARTS", 1)
    for name, levels in (("COARSE", warp.COARSE), ("MATCHED", warp.COARSE), ("FINE", warp.FINE)):
        put(register, name, levels[:1])
