"""Camera models of the rig: from pixels to rays and back, by OpenCV's functions, independent of the code that reads
depth images."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.model.camera import Camera

STEPS = 60
"""Iterations of the inverses; twenty reach double precision at the distortions of depth cameras."""


def pixel_rays(camera: Camera) -> FloatArray:
    """Return the ray of each pixel with z = 1, camera frame, shape (H, W, 3)."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    bent = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    straight = _straight(bent.reshape(-1, 2), camera).reshape(bent.shape)
    return np.concatenate([straight, np.ones((*u.shape, 1))], axis=-1)


def pixels_of(camera: Camera, local: FloatArray) -> FloatArray:
    """Return the pixels of points (p, 3) [m] in front of the camera, shape (p, 2)."""
    bent = _bent(local[:, :2] / local[:, 2:], camera)
    return np.asarray(bent * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def _straight(bent: FloatArray, camera: Camera) -> FloatArray:
    """Return the undistorted rays (n, 2) of distorted ones."""
    k = camera.distortion
    if not np.any(k != 0.0) or not len(bent):
        return bent
    if camera.distortion_model == "inverse_brown_conrady":
        return _polynomial(bent, k)
    if camera.distortion_model == "kannala_brandt":
        return _fisheye(bent, k[:4], inverse=True)
    return _solved(bent, k)


def _bent(straight: FloatArray, camera: Camera) -> FloatArray:
    """Return the distorted rays (n, 2) of undistorted ones."""
    k = camera.distortion
    if not np.any(k != 0.0) or not len(straight):
        return straight
    if camera.distortion_model == "inverse_brown_conrady":
        return _solved(straight, k)
    if camera.distortion_model == "kannala_brandt":
        return _fisheye(straight, k[:4], inverse=False)
    return _polynomial(straight, k)


def _polynomial(rays: FloatArray, k: FloatArray) -> FloatArray:
    import cv2

    spatial = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(cv2.projectPoints(spatial, np.zeros(3), np.zeros(3), np.eye(3), k)[0], dtype=np.float64).reshape(-1, 2)


def _solved(rays: FloatArray, k: FloatArray) -> FloatArray:
    """Return the rays that the polynomial maps to these, by fixed-point iteration."""
    found = rays.copy()
    for _ in range(STEPS):
        error = _polynomial(found, k) - rays
        found = found - error
        if np.abs(error).max() < 1e-12:
            break
    return np.asarray(found)


def _fisheye(rays: FloatArray, k: FloatArray, *, inverse: bool) -> FloatArray:
    import cv2

    points = np.ascontiguousarray(rays[:, None])
    if not inverse:
        return np.asarray(cv2.fisheye.distortPoints(points, np.eye(3), k), dtype=np.float64).reshape(-1, 2)
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, STEPS, 1e-13)
    found = cv2.fisheye.undistortPoints(points, np.eye(3), k, criteria=until)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)
