# pyright: strict
"""A user's script, which pyright checks in its strict mode: names, arguments and results have types."""

from pathlib import Path

import numpy as np

import rts

TRIANGLES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
CORNERS = (np.eye(4, 3) * [1, 1.5, 2] - 0.3).astype(np.float32)
SIZE = (128, 128)


def scene() -> list[rts.Part]:
    mesh = rts.Mesh(TRIANGLES, indices={"weights": None})
    assert mesh.faces.shape == TRIANGLES.shape
    tetrahedron = rts.Part(mesh, {"vertices": CORNERS, "weights": CORNERS[:, :1]}, "lambert")
    cage = rts.Subdivision(TRIANGLES.tolist(), "loop", creases=[(0, 1, 2.0)])
    ball = rts.Sdf(lambda theta, points: (points**2).sum(axis=1) - theta["radius"], radius=1.5, reads=("radius",))
    return [
        tetrahedron,
        rts.Part(cage, {"vertices": CORNERS + 2}, shader="normals"),
        rts.Part(ball, {"radius": np.ones(1, np.float32)}),
        rts.Revolution(np.linspace(-1, 1, 8), count=12).example(),
    ]


def pictures(parts: list[rts.Part], folder: Path) -> None:
    camera = rts.Camera.look_at((2, 1, 4), (0, 0, 0), fov_y=40)
    white = rts.render(parts, camera, SIZE, sampler="raster", background=(1.0, 1.0, 1.0))
    rts.save_image(folder / "white.png", white)
    over = rts.render(parts, camera, SIZE, splatter="multi", supersample=4, background=white)
    rts.save_image(folder / "over.png", over)
    views = rts.render_views(parts, [camera, camera], SIZE, layers="auto", supersample=2)
    print(views.shape, [choice.sampler for choice in rts.explain(parts, camera, SIZE)])


def pose_of(target: np.ndarray, part: rts.Part, start: np.ndarray) -> tuple[np.ndarray, float]:
    def posed(pose: np.ndarray) -> rts.Part:
        return part.replace(transform=rts.rigid(pose))

    camera = rts.Camera.perspective(40)
    residuals = rts.ImageResiduals(posed, camera, SIZE, target, background=None)
    fit = rts.fit(residuals, start, method="lm", schedule=rts.pyramid(SIZE))
    return fit.parameters, fit.loss


def field(path: str) -> np.ndarray:
    loaded = rts.load_radiance_field(path)
    camera = rts.Camera.look_at((0, 0, 4), (0, 0, 0))
    drawn = loaded.volume_render(camera, SIZE, background="white", ndc=rts.Ndc.of_images(SIZE, 100.0))
    return drawn.image + loaded.lattice(((-1, -1, -1), (1, 1, 1)), (8, 8, 8)).max()


def tuned(part: rts.Part, camera: rts.Camera) -> list[str]:
    found = rts.tune(lambda move: (part.replace(transform=rts.rigid(move)), camera), np.zeros(6), tolerance=0.1)
    rts.render(found.parts, camera, SIZE, **found.settings)
    return [*found.reasons, f"{found.seconds:.3f} s, {found.rate}"]
