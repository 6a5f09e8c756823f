"""Writes tests/colmap/, files and numbers of COLMAP itself: run by hand, with pycolmap 4.2.1 (pip install pycolmap numpy).

    python tests/colmap_truth.py

The product reads these files without COLMAP; the tests compare with truth.json.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

LENSES = {
    "SIMPLE_PINHOLE": [500.0, 310.0, 250.0],
    "PINHOLE": [500.0, 510.0, 310.0, 250.0],
    "SIMPLE_RADIAL": [500.0, 310.0, 250.0, 0.07],
    "RADIAL": [500.0, 310.0, 250.0, -0.2, 0.05],
    "OPENCV": [500.0, 510.0, 310.0, 250.0, 0.05, -0.02, 0.001, -0.002],
    "FULL_OPENCV": [500.0, 510.0, 310.0, 250.0, 0.05, -0.02, 0.001, -0.002, 0.003, 0.02, 0.01, -0.004],
    "SIMPLE_FISHEYE": [300.0, 310.0, 250.0],
    "FISHEYE": [300.0, 305.0, 310.0, 250.0],
    "SIMPLE_RADIAL_FISHEYE": [300.0, 310.0, 250.0, 0.04],
    "RADIAL_FISHEYE": [300.0, 310.0, 250.0, 0.04, -0.01],
    "OPENCV_FISHEYE": [300.0, 305.0, 310.0, 250.0, 0.05, -0.01, 0.004, -0.0007],
    "THIN_PRISM_FISHEYE": [300.0, 305.0, 310.0, 250.0, 0.05, -0.01, 0.001, -0.002, 0.004, -0.0007, 0.003, -0.004],
    "FOV": [400.0, 405.0, 310.0, 250.0, 0.9],
    "SIMPLE_DIVISION": [400.0, 310.0, 250.0, -0.1],
    "DIVISION": [400.0, 405.0, 310.0, 250.0, -0.1],
    "EUCM": [300.0, 305.0, 310.0, 250.0, 0.6, 1.1],
}
IMAGES = 3


def main(folder: Path) -> None:
    import pycolmap

    shutil.rmtree(folder, ignore_errors=True)
    draw = np.random.default_rng(0)
    points = draw.uniform(-0.6, 0.6, (8, 2))
    truth = {"pycolmap": pycolmap.__version__, "points": points.tolist(), "lenses": {}, "images": {}}
    for model, parameters in LENSES.items():
        camera = pycolmap.Camera(camera_id=1, model=model, width=620, height=500, params=parameters)
        pixels = [camera.img_from_cam(np.array([x, y, 1.0])) for x, y in points]
        truth["lenses"][model] = {"parameters": parameters, "pixels": np.array(pixels).tolist()}
    reconstruction = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for camera_id, model in enumerate(("OPENCV", "OPENCV_FISHEYE"), start=1):
        camera = pycolmap.Camera(camera_id=camera_id, model=model, width=620, height=500, params=LENSES[model])
        reconstruction.add_camera(camera)
        if camera_id == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, _pose(pycolmap, draw))
    reconstruction.add_rig(rig)
    for frame_id in range(1, IMAGES + 1):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1, rig_from_world=_pose(pycolmap, draw))
        images = []
        for camera_id in (1, 2):
            name = f"cam {camera_id}/{frame_id}.jpg"  # a space, and a folder for each camera, as rigs have it
            seen = pycolmap.Point2DList([pycolmap.Point2D(draw.uniform(0, 500, 2)) for _ in range(frame_id - 1)])
            image_id = 2 * frame_id + camera_id
            images.append(pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id, frame_id=frame_id, points2D=seen))
            frame.add_data_id(images[-1].data_id)
        reconstruction.add_frame(frame)
        for image in images:
            reconstruction.add_image(image)
    for image in reconstruction.images.values():
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        truth["images"][image.name] = {"camera": image.camera_id, "world_to_camera": pose.tolist()}
    for kind, write in (("binary", reconstruction.write_binary), ("text", reconstruction.write_text)):
        (folder / kind).mkdir(parents=True)
        write(folder / kind)
    (folder / "truth.json").write_text(json.dumps(truth) + "\n")


def _pose(pycolmap, draw: np.random.Generator):
    quaternion = draw.normal(size=4)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), draw.normal(size=3))


if __name__ == "__main__":
    main(Path(__file__).parent / "colmap")
