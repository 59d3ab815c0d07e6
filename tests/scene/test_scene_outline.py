"""vestcl.scene.motion.outline: what belongs to a moving object though its flow was missed."""

import cv2
import numpy as np

from vestcl.scene.flow.correspondence import Correspondence
from vestcl.scene.flow.parallax import pixel_centres
from vestcl.scene.motion.outline import whole_objects

HEIGHT, WIDTH = 96, 320
CAR, STEP = np.s_[40:70, 120:180], 6


def crossing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Images at t and t - 1 of a car that moves right by STEP, and where it is at t."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.random((HEIGHT, WIDTH, 3), np.float32), (0, 0), 1.2)
    car = np.float32(0.5) * cv2.GaussianBlur(rng.random((30, 60, 3), np.float32), (0, 0), 1.2)
    images = []
    for left in (CAR[1].start, CAR[1].start - STEP):
        image = wall.copy()
        image[CAR[0], left : left + 60] = car
        images.append(np.ascontiguousarray(image.transpose(2, 0, 1)))
    here = np.zeros((HEIGHT, WIDTH), bool)
    here[CAR] = True
    return images[0], images[1], here


def test_rim_and_window_are_added_and_nothing_else() -> None:
    image, image_prev, car = crossing()
    found = np.zeros_like(car)
    found[43:67, 123:177] = True  # flow missed a rim of three pixels
    found[48:54, 140:150] = False  # and a window
    flow = np.where(found, np.float32(-STEP), np.float32(0)) * np.array([1, 0], np.float32)[:, None, None]
    match = Correspondence(flow, np.where(found == car, 0, 9).astype(np.float32)[None])
    whole = whole_objects(found, image, image_prev, match, pixel_centres(HEIGHT, WIDTH))
    assert (whole & car).sum() > 0.88 * car.sum() > found.sum()
    assert (whole & ~car).sum() < 0.04 * car.sum()
    assert whole[48:54, 140:150].all()


def test_nothing_moves() -> None:
    image, _, car = crossing()
    match = Correspondence(np.zeros((2, HEIGHT, WIDTH), np.float32), np.zeros((1, HEIGHT, WIDTH), np.float32))
    assert not whole_objects(np.zeros_like(car), image, image, match, pixel_centres(HEIGHT, WIDTH)).any()


def plain(image: np.ndarray, region: tuple[slice, slice]) -> np.ndarray:
    image = image.copy()
    image[(slice(None), *region)] = 0.5
    return image


def test_windows_that_look_the_same_in_both_images_go_with_their_car() -> None:
    image, image_prev, car = crossing()
    window, notch = np.s_[46:54, 130:142], np.s_[58:62, 168:180]  # the second one touches the outline
    found = car.copy()
    found[window] = found[notch] = False
    images = [plain(plain(each, np.s_[44:56, 110:155]), np.s_[56:64, 155:196]) for each in (image, image_prev)]
    flow = np.where(found, np.float32(-STEP), np.float32(0)) * np.array([1, 0], np.float32)[:, None, None]
    match = Correspondence(flow, np.where(found == car, 0, 9).astype(np.float32)[None])
    whole = whole_objects(found, *images, match, pixel_centres(HEIGHT, WIDTH))
    assert whole[window].all() and whole[58:62, 168:176].all()


def test_the_road_inside_a_ring_of_traffic_stays() -> None:
    image, _, _ = crossing()
    ring = np.zeros((HEIGHT, WIDTH), bool)
    ring[10:86, 60:260] = True
    ring[20:76, 70:250] = False
    match = Correspondence(np.zeros((2, HEIGHT, WIDTH), np.float32), np.zeros((1, HEIGHT, WIDTH), np.float32))
    whole = whole_objects(ring, image, image, match, pixel_centres(HEIGHT, WIDTH))
    assert not whole[24:72, 74:246].any() and whole[ring].all()
