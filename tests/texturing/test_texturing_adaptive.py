"""Pictures baked with few samples are those that every texel's own samples make."""

import io

import numpy as np
import pytest
from PIL import Image

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.options import PatternName
from omtwarp.texturing.adaptive import bake_bytes
from omtwarp.texturing.atlas import make_atlas
from omtwarp.texturing.baking import Look, bake
from omtwarp.texturing.image import as_bytes, png_bytes
from omtwarp.texturing.patterns import pattern


@pytest.mark.parametrize("name", sorted(PatternName))
@pytest.mark.parametrize("atlas", ["equirectangular", "cube", "octahedral"])
def test_blocks_filled_at_once_look_as_texel_by_texel(name, atlas):
    """At most a texel in two thousand differs by more than a level: where an edge only just touches it."""
    layout = make_atlas(atlas, 510)
    quick = bake_bytes(name, Look(layout, resolve_device("cpu")))
    slow = as_bytes(bake(name, layout, device="cpu"))
    apart = np.abs(quick.astype(int) - slow).max(axis=2)
    assert (apart > 1).mean() < 5e-4


@pytest.mark.parametrize("name", sorted(PatternName))
def test_no_edge_within_the_reach(name):
    """Colours at random points within a direction's reach differ from its own by no more than a gradient's."""
    rng = np.random.default_rng(5)
    d = rng.normal(size=(20_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    given, colours = pattern(name), wp.empty((len(d), 3), dtype=wp.float64, device="cpu")
    reach = given.launch(wp.array(d, dtype=wp.vec3d, device="cpu"), colours).numpy()
    assert np.median(reach) > 1e-3, "else nothing is gained"
    for _ in range(4):
        away = np.cross(d, rng.normal(size=d.shape))
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        angle = (reach * rng.uniform(0.5, 1.0, len(d)))[:, None]
        near = given(np.cos(angle) * d + np.sin(angle) * away)
        step = np.abs(near - colours.numpy()).max(axis=1)
        # The sea along a coast changes by 0.3 in three degrees; a piece of the puzzle is 18 degrees long, and changes
        # by 0.14 in 0.045 of that next to its edge.
        steepest = {"globe": 10.0, "puzzle": 20.0}.get(name, 0.0)
        assert np.all(step <= 1e-9 + steepest * angle[:, 0])


@pytest.mark.parametrize("channels", [3, 4])
def test_pictures_are_the_same_as_png(channels):
    picture = np.random.default_rng(1).integers(0, 256, (31, 90, channels), dtype=np.uint8)
    with Image.open(io.BytesIO(png_bytes(picture))) as opened:
        assert "omtwarp" in opened.text["Software"].lower()
        np.testing.assert_array_equal(np.asarray(opened), picture)
