"""Makes the files of this folder: 32 random Gaussians as a .ply, and what two converters make of it.

Needs node and npm, which fetch the two into a temporary folder:

    python tests/data/splats/make.py
"""

import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
PACKAGES = ["@playcanvas/splat-transform@3.7.0", "@mkkellogg/gaussian-splats-3d@0.4.7"]
KSPLAT = """
import * as fs from 'fs';
globalThis.window = globalThis;
const { PlyLoader } = await import('@mkkellogg/gaussian-splats-3d');
const [,, from, to, level] = process.argv;
const data = fs.readFileSync(from);
const bytes = data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
const packed = await PlyLoader.loadFromFileData(bytes, 0, parseInt(level), true, 2);
fs.writeFileSync(to, Buffer.from(packed.bufferData));
"""


def write_original(path: Path, n: int = 32) -> None:
    """Centres far enough from each other to tell the Gaussians apart after they were put into another order."""
    draw = np.random.default_rng(7)
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    rows = {f"{axis}": value for axis, value in zip("xyz", (grid[:n] + draw.uniform(-0.2, 0.2, (n, 3)) - 1.5).T, strict=True)}
    rows |= {f"f_dc_{i}": draw.uniform(-1.5, 1.5, n) for i in range(3)}
    rows |= {f"f_rest_{i}": draw.uniform(-0.5, 0.5, n) for i in range(45)}
    rows |= {"opacity": draw.uniform(-3, 3, n)} | {f"scale_{i}": draw.uniform(-6, -1, n) for i in range(3)}
    rows |= {f"rot_{i}": draw.normal(size=n) for i in range(4)}
    head = "ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: mip\n"
    head += f"element vertex {n}\n" + "".join(f"property float {name}\n" for name in rows) + "end_header\n"
    path.write_bytes(head.encode() + b"".join(struct.pack(f"<{len(rows)}f", *row) for row in zip(*rows.values(), strict=True)))


def main() -> None:
    original = HERE / "original.ply"
    write_original(original)
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["npm", "install", "--silent", "--prefix", folder, *PACKAGES], check=True)
        convert = ["node", f"{folder}/node_modules/.bin/splat-transform", "-q", "-w", "-g", "cpu"]
        for name, options in {
            "v4.spz": [],
            "v3.spz": ["--spz-version", "3"],
            "packed.compressed.ply": [],
            "v2.sog": [],
            "plain.glb": [],
        }.items():
            subprocess.run([*convert, *options, str(original), str(HERE / name)], check=True)
        (Path(folder) / "ksplat.mjs").write_text(KSPLAT)
        for level in (0, 1, 2):
            to = HERE / f"level{level}.ksplat"
            subprocess.run(["node", f"{folder}/ksplat.mjs", str(original), str(to), str(level)], check=True)
    for path in sorted(HERE.iterdir()):
        print(f"{path.stat().st_size:6,} {path.name}")


if __name__ == "__main__":
    main()
