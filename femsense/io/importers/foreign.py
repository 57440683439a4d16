"""Formats that only the camera's own program reads, each with the export that `femsense import` reads."""

from __future__ import annotations

from pathlib import Path

IMAGES = "put its depth images into depth/ and its colour images into color/ of one folder, with the lens in intrinsic.json"
EXPORTS = {
    (".svo", ".svo2"): (
        "a ZED capture: only the ZED SDK computes its depth. Its sample 'svo export' writes images: "
        "svo_export.py --mode 4 --input_svo_file {name} --output_path_dir OUT (LEFT + DEPTH_16Bit, millimetres); "
        f"{IMAGES}, then femsense import FOLDER"
    ),
    (".oni",): (
        "an OpenNI capture (Astra, Xtion, Kinect 1): replay it with ROS (openni2_camera) and record a bag of its depth images and "
        "camera_info, or save each frame as PLY with PCL or Open3D; then femsense import that"
    ),
    (
        ".rrf",
    ): "a Royale capture (pmd, PicoFlexx): play it in Royale Viewer and export PLY files into one folder, then femsense import FOLDER",
    (
        ".zdf",
    ): "a Zivid frame: in Zivid Studio save it as PLY, or in Python zivid.Frame('{name}').save('frame.ply'); then femsense import FOLDER",
    (".sens",): (
        "a ScanNet capture: SensReader writes images: reader.py --filename {name} --output_path OUT --export_depth_images "
        f"--export_color_images --export_intrinsics; {IMAGES}, then femsense import FOLDER"
    ),
    (".mp4", ".avi", ".mov", ".webm"): (
        "a video has no depth: export depth images or clouds from the program that recorded it, not the picture that it shows"
    ),
}
"""Suffixes → description and export command; `{name}` is the file."""


def export_hint(path: Path) -> str | None:
    """Return how a capture of another program is exported; None where its ending is none of these."""
    for endings, text in EXPORTS.items():
        if path.suffix.lower() in endings:
            return text.replace("{name}", path.name)
    return None
