"""Scenes as binary glTF 2.0 (.glb), which browsers, Blender and presentation programs open.

Open3D 0.20 writes .glb with base64 text instead of a binary part, which its own reader refuses.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from lab.files.text.atomic_write import atomic_write_bytes
from lab.view.solids import Mesh

_FLOAT, _UINT32, _VERTICES, _INDICES = 5126, 5125, 34962, 34963
_UPRIGHT = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # glTF's y is up, the lab's z: a turn of -90 degrees about x


def write_glb(mesh: Mesh, path: Path) -> None:
    """Write a mesh with vertex colours, complete or not at all. Raises InputError."""
    points = mesh.vertices.astype("<f4")
    blocks = [
        (points.tobytes(), _VERTICES),
        (_linear(mesh.colours).astype("<f4").tobytes(), _VERTICES),
        (mesh.triangles.astype("<u4").tobytes(), _INDICES),
    ]
    starts = np.cumsum([0, *(len(data) for data, _ in blocks)])
    n = len(points)
    span = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    tree = {
        "asset": {"version": "2.0", "generator": "beampose"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _UPRIGHT}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}, "doubleSided": True}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": n, "type": "VEC3", **span},
            {"bufferView": 1, "componentType": _FLOAT, "count": n, "type": "VEC3"},
            {"bufferView": 2, "componentType": _UINT32, "count": mesh.triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(data), "target": target}
            for (data, target), start in zip(blocks, starts, strict=False)
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(data for data, _ in blocks)  # float32 and uint32: a multiple of four bytes
    parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    atomic_write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts, path)


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Light intensities of sRGB colours, as glTF has them."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
