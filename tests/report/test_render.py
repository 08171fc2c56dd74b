import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from shapespace.errors import InputError
from shapespace.report.render.renderer import Camera, Layer, blur, render, render_series, visible_triangles
from shapespace.types import FloatArray, Mesh

SIZE = (57, 43)
RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def soup(seed: int, count: int = 40) -> Mesh:
    rng = np.random.default_rng(seed)
    corners = np.add(rng.normal(0, 10, (count, 1, 3)), rng.normal(0, 6, (count, 3, 3)))
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def square(z: float, half: float = 10.0, x: float = 0.0) -> Mesh:
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]]) + np.array([x, 0, 0])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def ball(radius: float = 10.0, n: int = 24) -> Mesh:
    u, v = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    points = radius * np.stack([np.sin(u) * np.sin(v), np.cos(u), np.sin(u) * np.cos(v)], axis=-1).reshape(-1, 3)
    i = np.arange(n * 2 * n).reshape(n, 2 * n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return Mesh(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


@pytest.mark.parametrize("sigma", [0.2, 0.7, 3.1, 12.0])
@pytest.mark.parametrize("shape", [(1, 1), (5, 9), (40, 31)])
def test_blurs_are_those_of_scipy(sigma: float, shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).normal(100, 10, shape).astype(np.float32)
    weights = np.exp(-0.5 / sigma**2 * np.arange(int(2.5 * sigma + 0.5) + 1) ** 2)
    blurred = blur(image, weights / (weights[0] + 2 * weights[1:].sum()))
    np.testing.assert_allclose(blurred, gaussian_filter(image, sigma, truncate=2.5), rtol=1e-6)


def brute_force(mesh: Mesh, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Meet the ray of each pixel's centre with each triangle in three dimensions, knowing nothing of the screen."""
    width, height = SIZE
    yaw, pitch = np.radians([camera.yaw_deg, camera.pitch_deg])
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    points = (about_x @ about_y @ (mesh.vertices - camera.centre).T).T
    winner, nearest = np.full((height, width), -1), np.full((height, width), np.inf)
    per_pixel = camera.height_mm / height
    assert mesh.faces is not None
    for row in range(height):
        for column in range(width):
            target = np.array([(column + 0.5 - width / 2) * per_pixel, (height / 2 - row - 0.5) * per_pixel, 0.0])
            if camera.distance_mm is None:
                origin, ray = target + np.array([0, 0, 1000.0]), np.array([0, 0, -1.0])
            else:
                origin = np.array([0, 0, camera.distance_mm])
                ray = target - origin
            for k, face in enumerate(mesh.faces):
                a, b, c = points[face]
                system = np.stack([b - a, c - a, -ray], axis=1)
                if abs(np.linalg.det(system)) < 1e-9:
                    continue
                s, t, along = np.linalg.solve(system, origin - a)
                if s >= 0 and t >= 0 and s + t <= 1 and along > 0 and along < nearest[row, column]:
                    nearest[row, column], winner[row, column] = along, k
    return winner, nearest


@pytest.mark.parametrize("distance_mm", [None, 90.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_each_pixel_shows_the_triangle_that_its_ray_meets_first(seed: int, distance_mm: float | None) -> None:
    mesh = soup(seed, 25)
    camera = Camera(np.array([1.0, -2.0, 0.5]), 40.0, 25.0, -10.0, distance_mm)
    triangle, depth = visible_triangles(mesh, camera=camera, size=SIZE)
    expected, along = brute_force(mesh, camera)
    assert (triangle == expected).all()
    assert (expected >= 0).sum() > 500 and (expected < 0).sum() > 50
    seen = expected >= 0
    assert np.isinf(depth[~seen]).all()
    if distance_mm is None:
        np.testing.assert_allclose(depth[seen], along[seen] - 1000.0, atol=1e-7)
    else:
        np.testing.assert_allclose(-1 / depth[seen], along[seen] * distance_mm, rtol=1e-7)


def test_triangles_that_share_edges_leave_no_gap_and_no_pixel_outside() -> None:
    n = 23
    x, y = np.meshgrid(np.linspace(-10, 10, n), np.linspace(-10, 10, n))
    rng = np.random.default_rng(5)
    points = np.stack([x.ravel(), y.ravel(), rng.normal(0, 0.5, n * n)], axis=1)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    mesh = Mesh(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    triangle, _ = visible_triangles(mesh, camera=Camera(np.zeros(3), 40.0), size=(400, 400))
    inside = np.zeros((400, 400), dtype=bool)
    inside[100:300, 100:300] = True
    assert ((triangle >= 0) == inside).all()


def test_of_two_opaque_layers_the_nearer_one_wins_whatever_the_order() -> None:
    camera = Camera(np.zeros(3), 30.0)
    near, far = Layer(square(5.0, x=4.0), RED), Layer(square(-5.0, x=-4.0), BLUE)
    one = render(near, far, camera=camera, size=(60, 60))
    other = render(far, near, camera=camera, size=(60, 60))
    assert (one == other).all()
    assert one[30, 30, 0] > 100 > one[30, 30, 2]
    assert one[30, 8, 2] > 100 > one[30, 8, 0]


def test_bands_of_a_map_are_cut_where_the_scalar_crosses_the_limit() -> None:
    mesh = square(0.0)
    colours = np.array([RED, BLUE])
    camera = Camera(np.zeros(3), 30.0)
    layer = Layer(mesh, scalars=mesh.vertices[:, 0], colormap=colours, vmin=-4, vmax=8)
    image = render(layer, camera=camera, size=(300, 300))
    red = image[150, :, 0].astype(int) > image[150, :, 2].astype(int) + 50
    blue = image[150, :, 2].astype(int) > image[150, :, 0].astype(int) + 50
    assert abs(np.flatnonzero(red).max() - 169) <= 1
    assert abs(np.flatnonzero(blue).min() - 170) <= 1


def test_values_that_are_not_finite_are_grey() -> None:
    mesh = square(0.0)
    layer = Layer(mesh, scalars=np.full(4, np.nan), colormap=np.array([RED, BLUE]))
    image = render(layer, camera=Camera(np.zeros(3), 30.0), size=(20, 20))
    assert np.ptp(image[10, 10].astype(int)) <= 2


def test_maps_of_one_view_equal_the_pictures_taken_one_by_one() -> None:
    mesh, camera, table = ball(), Camera(np.zeros(3), 30.0), np.array([RED, BLUE])
    ranges = [(-1.0, 1.0), (-5.0, 9.0)]
    maps = [Layer(mesh, scalars=mesh.vertices[:, 1], colormap=table, vmin=low, vmax=high) for low, high in ranges]
    for image, layer in zip(render_series([[m] for m in maps], camera=camera, size=(40, 40)), maps, strict=True):
        assert (image == render(layer, camera=camera, size=(40, 40))).all()
    a, b = Layer(mesh, RED), Layer(square(0.0), BLUE)
    series = render_series([[a], [b], [a, b]], camera=camera, size=(40, 40))
    for image, layers in zip(series, ([a], [b], [a, b]), strict=True):
        assert (image == render(*layers, camera=camera, size=(40, 40))).all()


def test_the_inside_of_a_surface_is_darker_than_its_outside() -> None:
    mesh = square(0.0)
    assert mesh.faces is not None
    camera = Camera(np.zeros(3), 30.0)
    front = render(Layer(mesh), camera=camera, size=(20, 20))
    back = render(Layer(Mesh(mesh.vertices, mesh.faces[:, ::-1])), camera=camera, size=(20, 20))
    assert back[10, 10].mean() < 0.8 * front[10, 10].mean()


def test_points_are_drawn_as_round_discs_of_their_radius() -> None:
    cloud = Mesh(np.array([[0.0, 0.0, 0.0]]))
    image = render(
        Layer(cloud, RED, point_radius_mm=5.0), camera=Camera(np.zeros(3), 20.0), size=(100, 100), supersample=1
    )
    drawn = (image != 255).any(axis=2)
    y, x = np.mgrid[:100, :100] + 0.5
    assert (drawn == ((x - 50) ** 2 + (y - 50) ** 2 <= 25**2)).all()


def test_framing_keeps_every_point_in_the_picture() -> None:
    rng = np.random.default_rng(2)
    for yaw, pitch, aspect in ((0, 0, 1.0), (40, -20, 0.7), (-75, 30, 1.8)):
        points = rng.normal(0, 1, (300, 3)) * [80, 110, 90] + [3, -400, 70]
        camera = Camera.framing(points, yaw_deg=yaw, pitch_deg=pitch, aspect=aspect)
        size = (round(300 * aspect), 300)
        image = render(Layer(Mesh(points), RED, point_radius_mm=0.1), camera=camera, size=size, supersample=1)
        drawn = (image != 255).any(axis=2)
        assert not (drawn[0].any() or drawn[-1].any() or drawn[:, 0].any() or drawn[:, -1].any())
        filled = [np.ptp(np.flatnonzero(drawn.any(axis=axis))) / drawn.shape[1 - axis] for axis in (0, 1)]
        assert max(filled) > 0.75


def test_a_picture_is_the_same_every_time_on_white() -> None:
    camera = Camera.framing(ball().vertices, yaw_deg=20)
    first, second = (render(Layer(ball()), camera=camera, size=(80, 80)) for _ in range(2))
    assert (first == second).all()
    assert first[0, 0].tolist() == [255, 255, 255]


def test_what_is_behind_the_eye_is_not_drawn() -> None:
    image = render(Layer(square(500.0)), camera=Camera(np.zeros(3), 30.0, distance_mm=100.0), size=(20, 20))
    assert (image == 255).all()


def test_an_empty_list_of_layers_gives_the_background() -> None:
    assert (render(camera=Camera(np.zeros(3), 1.0), size=(5, 4)) == 255).all()


@pytest.mark.parametrize("scalars", [np.zeros(3), np.zeros((4, 1))])
def test_scalars_that_do_not_fit_the_vertices_are_refused(scalars: FloatArray) -> None:
    with pytest.raises(InputError, match="4 vertices"):
        Layer(square(0.0), scalars=scalars, colormap=np.array([RED, BLUE]))


def test_pictures_and_cameras_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="cannot be drawn"):
        render(Layer(square(0.0)), camera=Camera(np.zeros(3), 1.0), size=(100_000, 100_000))
    with pytest.raises(InputError, match="positive"):
        Camera(np.zeros(3), 0.0)
    with pytest.raises(InputError, match="at least one point"):
        Camera.framing(np.zeros((0, 3)))
    with pytest.raises(InputError, match="empty"):
        Layer(square(0.0), scalars=np.zeros(4), colormap=np.array([RED, BLUE]), vmin=1.0, vmax=1.0)
