"""A scene in pictures as a run folder in the documented file formats; rig.yaml states the noise only on request."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from bench.random_pictures.render import Renderer
from bench.random_pictures.sensors import Sensor
from bench.random_scenes.write_folder import prior_block, write_truth
from geometry.camera import SensorNoise
from geometry.rig import Rig
from lab.files.rig.rig_file import RigFile, save_rig
from lab.files.run.run_file import save_run

# Noise does not compress: 11 ms for 1280x1024 instead of 27 at level 1 with filters, and no larger file.
_FAST_PNG = (
    cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)  # fmt: skip


def write_pictures(renderer: Renderer, folder: Path, state_noise: bool = False) -> Path:
    """Write rig.yaml, run.yaml, truth and the pictures: PNG or JPEG files per camera, or an MJPG video.

    state_noise: rig.yaml states the true noise of the sensor (without that of lossy compression), to distinguish errors
    of the noise estimate from those of the detector.
    """
    ps = renderer.ps
    scene, sensor = ps.scene, ps.look.sensor
    folder.mkdir(parents=True, exist_ok=True)
    rig = _with_noise(scene.known_rig, sensor) if state_noise else scene.known_rig
    save_rig(RigFile(rig), folder / "rig.yaml")
    video = sensor.file_format == "mjpg"
    content: dict[str, object] = {
        "name": f"{ps.family or 'mixed'}-{ps.seed}",
        "rig": "rig.yaml",
        "frame_rate_hz": scene.frame_rate_hz,
        "exposure_s": ps.look.exposure_share / scene.frame_rate_hz,
        "cameras": {name: {"frames": f"{name}.avi" if video else f"frames/{name}"} for name in scene.rig.cameras},
        "notes": ps.text,
    }
    save_run(content | prior_block(scene), folder)
    write_truth(scene, folder)
    for c, name in enumerate(scene.rig.cameras):
        if video:
            _write_video(renderer, c, folder / f"{name}.avi")
        else:
            _write_files(renderer, c, folder / "frames" / name)
    return folder


def _with_noise(rig: Rig, sensor: Sensor) -> Rig:
    """The rig with the noise of the sensor in every camera, in units of its files."""
    scale = float(1 << sensor.shift)
    read_e = float(np.hypot(sensor.read_e, sensor.row_e))
    noise = SensorNoise(sensor.gain_e_per_dn / scale, read_e, sensor.black_dn * scale)
    return replace(rig, cameras={name: replace(camera, noise=noise) for name, camera in rig.cameras.items()})


def _write_files(renderer: Renderer, camera: int, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    sensor, scene = renderer.ps.look.sensor, renderer.ps.scene
    how = [cv2.IMWRITE_JPEG_QUALITY, sensor.quality] if sensor.lossy else list(_FAST_PNG)
    for k in range(len(scene)):
        if not scene.has_image[k, camera]:
            renderer.expected(k, camera)  # the SNR of the spots
            continue
        path = folder / f"{k:06}.{'jpg' if sensor.lossy else 'png'}"
        if not cv2.imwrite(str(path), renderer.raw(k, camera), how):
            raise RuntimeError(f"{path}: cannot be written")


def _write_video(renderer: Renderer, camera: int, path: Path) -> None:
    size = list(renderer.ps.scene.rig.cameras.values())[camera].image_size_px
    # The built-in writer of OpenCV: FFmpeg ignores the quality. In colour: its grey videos are damaged (5.0.0).
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, size,
        [cv2.VIDEOWRITER_PROP_IS_COLOR, 1, cv2.VIDEOWRITER_PROP_QUALITY, renderer.ps.look.sensor.quality],
    )  # fmt: skip
    if not writer.isOpened():
        raise RuntimeError(f"{path}: OpenCV cannot write an MJPG video")
    for k in range(len(renderer.ps)):
        writer.write(cv2.cvtColor(renderer.raw(k, camera), cv2.COLOR_GRAY2BGR))
    writer.release()
