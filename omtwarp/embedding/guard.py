"""Steps that cannot flip: a motion shortened only where it would turn a triangle over."""

from __future__ import annotations

from typing import Any

from omtwarp._warp import wp
from omtwarp.embedding.guard_kernels import end_round, flag_bad_steps, flag_flips, shorten_steps
from omtwarp.mesh.surface import Surface

# A vertex whose step was halved this often stays where it was.
HALVINGS = 6
MAXIMUM_ROUNDS = 500
# A step that leaves a triangle a hundredth of its area is as good as a flip: on scanned shapes a single such triangle
# costs the whole map's area distortion more than the step gains.
SMALLEST_PART = 0.2


class StepGuard:
    """Keeps every triangle of a moving sphere map positive, and from all but vanishing.

    A vertex of a triangle that a step would flip has its own step halved, again and again, and is held in the end; its
    neighbours follow only where that in turn would flip one of theirs. Since the map before the step has no flip,
    holding vertices always ends in a map without one, and a few bad triangles slow nobody but themselves.

    Args:
        surface: the surface; its triangles' areas, total 4π, are what they should have on the sphere.
        device: where the kernels run.
        smallest: a step may shrink no triangle below this part of its area on the surface; a triangle that is smaller
            already may only grow. With 0 only flips count.

    Attributes:
        held: how many vertices the last step was shortened for, Warp int32 [1] on the device.
    """

    def __init__(self, surface: Surface, device: Any, smallest: float = SMALLEST_PART):
        self.device = device
        self.vertex_count = surface.vertex_count
        self.face_count = surface.face_count
        self._faces = wp.array(surface.faces, dtype=wp.vec3i, device=device)
        offsets, corners = surface.vertex_corners
        self._offsets = wp.array(offsets, dtype=wp.int32, device=device)
        self._corners = wp.array(corners, dtype=wp.int32, device=device)
        # det[s0, s1, s2] of a small triangle is twice its area.
        self._floors = wp.array(2.0 * smallest * surface.face_areas, dtype=wp.float64, device=device)
        self._flags = wp.empty(self.face_count, dtype=wp.int32, device=device)
        self._counters = wp.zeros(3, dtype=wp.int32, device=device)
        self._count, self._rounds, self.held = (self._counters[k : k + 1] for k in range(3))
        self._again = wp.empty(1, dtype=wp.int32, device=device)
        self._halvings = wp.empty(self.vertex_count, dtype=wp.int32, device=device)
        self._changed = wp.empty(self.vertex_count, dtype=wp.int32, device=device)
        self._wanted = wp.empty(self.vertex_count, dtype=wp.vec3d, device=device)

    def count(self, points: Any) -> int:
        """Triangles with det[s0, s1, s2] <= 0 in a map, a Warp array of vec3d [V]."""
        self._count.zero_()
        inputs = [points, self._faces, self._flags, self._count]
        wp.launch(flag_flips, dim=self.face_count, inputs=inputs, device=self.device)
        return int(self._count.numpy()[0])

    def _find_bad(self, old: Any, new: Any, everywhere: bool) -> None:
        inputs = [old, new, self._faces, self._floors, int(everywhere), self._changed]
        wp.launch(
            flag_bad_steps, dim=self.face_count, inputs=inputs, outputs=[self._flags, self._count], device=self.device
        )
        inputs = [MAXIMUM_ROUNDS, self._count, self._rounds]
        wp.launch(end_round, dim=1, inputs=inputs, outputs=[self._again], device=self.device)

    def hold(self, old: Any, new: Any) -> None:
        """Shorten the step from ``old`` (without flips) to ``new``, in place, until nothing flips or shrinks too far.

        All of it happens on the device, and can be part of a graph; :attr:`held` says how many vertices it touched.
        """
        self._counters.zero_()
        self._halvings.zero_()
        self._find_bad(old, new, everywhere=True)

        def shorten() -> None:
            wp.launch(
                shorten_steps,
                dim=self.vertex_count,
                inputs=[old, self._offsets, self._corners, self._flags, HALVINGS, self._rounds, MAXIMUM_ROUNDS],
                outputs=[self._halvings, self._wanted, new, self.held, self._changed],
                device=self.device,
            )
            self._find_bad(old, new, everywhere=False)

        wp.capture_while(self._again, shorten)

    def limit(self, old: Any, new: Any) -> int:
        """:meth:`hold`, and the number of vertices whose step was shortened."""
        self.hold(old, new)
        return int(self.held.numpy()[0])
