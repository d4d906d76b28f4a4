"""Small meshes with texture coordinates and several materials, as files."""

import numpy as np
from PIL import Image

import omtwarp

RED, BLUE = (220, 40, 30), (20, 60, 210)


def two_halves(folder, *, picture=False, name="two.obj"):
    """A ball whose upper half is red and whose lower half is blue; with ``picture`` the lower has a picture of stripes.

    Coordinates are longitude and height, corner by corner, so that nothing is smeared at the seam.
    """
    ball = omtwarp.shapes.icosphere(6)
    points, faces = ball.vertices, ball.faces
    corner = points[faces]
    u = np.arctan2(corner[..., 1], corner[..., 0]) / (2 * np.pi) + 0.5
    u = np.where((u.max(axis=1) - u.min(axis=1) > 0.5)[:, None] & (u < 0.5), u + 1.0, u)
    uv = np.stack([u, 0.5 + 0.49 * corner[..., 2]], axis=2)
    upper = corner[..., 2].mean(axis=1) > 0
    lines = ["mtllib two.mtl"]
    lines += ["v {} {} {}".format(*map(repr, row)) for row in points.tolist()]
    lines += [f"vt {a!r} {b!r}" for a, b in uv.reshape(-1, 2).tolist()]
    lines.append("usemtl red")
    for half, material in ((upper, "red"), (~upper, "blue")):
        lines.append(f"usemtl {material}")
        lines += [
            "f " + " ".join(f"{v + 1}/{3 * f + k + 1}" for k, v in enumerate(faces[f])) for f in np.flatnonzero(half)
        ]
    (folder / name).write_text("\n".join(lines) + "\n")
    red, blue = (" ".join(f"{c / 255:.6f}" for c in color) for color in (RED, BLUE))
    library = f"newmtl red\nKd {red}\nnewmtl blue\n"
    if picture:
        stripes = np.zeros((32, 64, 3), dtype=np.uint8)
        stripes[:, ::2] = BLUE
        stripes[:, 1::2] = (240, 240, 240)
        Image.fromarray(np.repeat(np.repeat(stripes, 8, 0), 8, 1)).save(folder / "stripes.png")
        library += "Kd 1 1 1\nmap_Kd -clamp off stripes.png\n"
    else:
        library += f"Kd {blue}\n"
    (folder / "two.mtl").write_text(library)
    return folder / name, np.flatnonzero(upper), uv
