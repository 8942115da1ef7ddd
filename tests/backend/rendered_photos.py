"""Photos of a textured room, rendered from exact poses, and the errors of poses that were found of them."""

import functools

import numpy as np
import pycolmap
from PIL import Image

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
VIEWS = 7


@functools.cache
def texture(seed: int, size: int = 512) -> np.ndarray:
    """Return a random texture (size, size, 3) with details of many sizes."""
    rng = np.random.default_rng(seed)
    values = np.zeros((size, size, 3))
    for cells in (8, 16, 32, 64, 128):
        small = Image.fromarray(rng.integers(0, 256, (cells, cells, 3), np.uint8))
        values += np.asarray(small.resize((size, size), Image.Resampling.BICUBIC), float)
    values -= values.min()
    return 255 * values / values.max()


def pose(center, target) -> np.ndarray:
    """Return the world-to-camera matrix (3, 4) of a camera at `center` that looks at `target`, with y down."""
    forward = np.asarray(target, float) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ center])


def photo(matrix: np.ndarray, seed: int = 0, fisheye: float = 0.0) -> np.ndarray:
    """Render a textured floor, two walls and two boxes as (HEIGHT, WIDTH, 3) uint8; see `photo_and_places`."""
    return photo_and_places(matrix, seed, fisheye)[0]


def photo_and_places(matrix: np.ndarray, seed: int = 0, fisheye: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a photo, and the place in the world (HEIGHT, WIDTH, 3) that each of its pixels shows.

    Each pixel's distance from the center is `fisheye` times the angle to the axis, unless that is 0.
    """
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([x - WIDTH / 2, y - HEIGHT / 2, np.full_like(x, FOCAL)], -1)
    if fisheye:
        radii = np.linalg.norm(rays[..., :2], axis=2)
        rays[..., 2] = radii / np.tan(radii / fisheye)
    rays = rays @ matrix[:, :3]
    center = -matrix[:, :3].T @ matrix[:, 3]
    nearest, image = np.full(x.shape, np.inf), np.zeros((*x.shape, 3))
    places = np.zeros((*x.shape, 3))
    planes = [(2, 0.0, None), (1, 2.5, None), (0, -2.5, None)]
    for low, high in (((-0.6, -0.3, 0.0), (0.0, 0.4, 0.7)), ((0.4, -0.7, 0.0), (0.9, 0.0, 0.4))):
        planes += [(axis, side, (low, high)) for axis in range(3) for side in (low[axis], high[axis])]
    for number, (axis, at, box) in enumerate(planes):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (at - center[axis]) / rays[..., axis]
            place = center + distance[..., None] * rays
        hit = (distance > 0) & (distance < nearest)
        for other in range(3):
            if box is not None and other != axis:
                hit &= (place[..., other] >= box[0][other]) & (place[..., other] <= box[1][other])
        across = np.nan_to_num(place[..., [other for other in range(3) if other != axis]], posinf=0, neginf=0)
        cells = (np.clip(across, -50, 50) * 160).astype(int) % 512
        nearest = np.where(hit, distance, nearest)
        places = np.where(hit[..., None], place, places)
        image = np.where(hit[..., None], texture(seed + number)[cells[..., 0], cells[..., 1]], image)
    return image.astype(np.uint8), places


def write_photos(folder, matrices, seed: int = 0, names=None) -> None:
    folder.mkdir(parents=True)
    for number, matrix in enumerate(matrices):
        name = names[number] if names else f"photo {number + 1}.png"  # A space, and 10 after 9.
        Image.fromarray(photo(matrix, seed)).save(folder / name)


def ring(count: int = VIEWS, turn: float = 0.0) -> list[np.ndarray]:
    angles = turn + np.linspace(-1.0, 0.2, count)
    centers = np.stack([2.2 * np.cos(angles), 2.2 * np.sin(angles), 1.2 + 0.1 * np.sin(5 * angles)], 1)
    return [pose(center, (0.1, 0.0, 0.3)) for center in centers]


def pose_errors(capture, matrices, names=None) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of rotations in degrees, and of positions relative to the size of the ring, after a fit."""
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    found = {model.image(i).name: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
    names = names or [f"photo {number + 1}.png" for number in range(len(matrices))]
    true = {name: matrix for name, matrix in zip(names, matrices) if name in found}
    here = np.array([-found[name][:, :3].T @ found[name][:, 3] for name in true])
    there = np.array([-matrix[:, :3].T @ matrix[:, 3] for matrix in true.values()])
    a, b = here - here.mean(0), there - there.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    moved = (s * np.diag(flip)).sum() / (a**2).sum() * a @ rotation.T
    turns = [found[name][:, :3] @ rotation.T @ true[name][:, :3].T for name in true]
    degrees = np.degrees([np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) for turn in turns])
    return degrees, np.linalg.norm(moved - b, axis=1) / np.linalg.norm(np.ptp(there, axis=0))
