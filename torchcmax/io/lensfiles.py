"""Calibrations of Kalibr, ROS, DSEC and OpenCV, in the words of our own."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any

import yaml

from torchcmax.io.errors import DataError, DataNote, tell

DISTORTIONS = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "none": "plumb_bob",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
}
SUPPORTED = f"supported: a pinhole camera with distortion {', '.join(DISTORTIONS)}; or calibrate again with one of these"


class LensLoader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """Safe YAML that knows OpenCV's tag for a matrix."""


LensLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True))


def yaml_of(text: str) -> Any:
    """What the YAML holds; OpenCV's first line, `%YAML:1.0`, is none of YAML's and is left out."""
    return yaml.load(text.split("\n", 1)[-1] if text.startswith("%YAML:") else text, Loader=LensLoader)


def in_our_words(file: str, found: Any) -> Any:
    """Another tool's calibration with our names (model, width, height, fx, ...); anything unknown as it is."""
    if not isinstance(found, dict):
        return found
    cameras = found["intrinsics"] if isinstance(found.get("intrinsics"), dict) else found
    if isinstance(cameras.get("cam0"), dict):
        others = [str(key) for key in cameras if str(key).startswith("cam") and key != "cam0"]
        if others:
            tell(DataNote(f"{file}: cam0 is taken; left out: {', '.join(others)}"))
        camera = cameras["cam0"]
        return _ours(file, camera, camera.get("camera_matrix", camera.get("intrinsics")), camera.get("distortion_coeffs"))
    if "camera_matrix" in found and "image_width" in found:
        matrix = _data(file, found, "camera_matrix")
        if not isinstance(matrix, list) or len(matrix) != 9:
            raise DataError(file, f"camera_matrix is {reprlib.repr(matrix)}", "it wants the 9 numbers of a 3 x 3 matrix")
        return _ours(file, found, [matrix[0], matrix[4], matrix[2], matrix[5]], _data(file, found, "distortion_coefficients"))
    return found


def _data(file: str, found: Mapping[str, Any], key: str) -> Any:
    """The numbers of a matrix."""
    matrix = found.get(key)
    if not isinstance(matrix, dict) or "data" not in matrix:
        raise DataError(file, f"{key} has no data", "it wants rows, cols and data, as ROS and OpenCV write them")
    return matrix["data"]


def _ours(file: str, camera: Mapping[str, Any], focal: Any, distortion: Any) -> dict[str, Any]:
    """One camera in our words; its numbers are looked at by whoever takes them."""
    told = str(camera.get("distortion_model", "plumb_bob"))
    if told == "rational_polynomial" and isinstance(distortion, list) and len(distortion) >= 5 and not any(distortion[5:]):
        told, distortion = "plumb_bob", distortion[:5]  # without k4, k5, k6 it is the same
    if "distortion_model" not in camera and isinstance(distortion, list) and any(distortion):
        tell(DataNote(f"{file}: does not name its distortion_model, plumb_bob is taken"))
    if told not in DISTORTIONS or str(camera.get("camera_model", "pinhole")) != "pinhole":
        raise DataError(file, f"camera model {camera.get('camera_model', 'pinhole')} with distortion {told[:40]}", SUPPORTED)
    size = camera.get("resolution", [camera.get("image_width"), camera.get("image_height")])
    if not isinstance(focal, list) or len(focal) != 4 or not isinstance(size, list) or len(size) != 2:
        raise DataError(file, f"intrinsics {reprlib.repr(focal)}, size {reprlib.repr(size)}", "it wants fx, fy, cx, cy and width, height")
    model, listed = DISTORTIONS[told], [] if told == "none" or distortion is None else distortion
    if model == "plumb_bob" and isinstance(listed, list) and len(listed) == 4:
        listed = [*listed, 0.0]
    ours = dict(zip(("fx", "fy", "cx", "cy"), focal, strict=True))
    return ours | {"model": model, "width": size[0], "height": size[1], "distortion": listed}
