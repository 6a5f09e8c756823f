"""Packed formats give back the Gaussians that were packed, to what their bits can hold.

Truth comes from two sides: files that splat-transform 3.7.0 and mkkellogg's viewer 0.4.7 made (tests/data/splats, with the
script that made them), and files that `splat_files` writes value by value.
"""

from __future__ import annotations

import json
import struct
import zipfile

import numpy as np
import pytest
import roma
import torch
from plyfile import PlyData
from splat_files import (
    DATA,
    a_cloud,
    covariances,
    matched,
    write_first_sog,
    write_gltf,
    write_ksplat,
    write_ply,
    write_splat,
    write_spz,
)

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.similarity import moved
from pgsd_nerfstudio.scene.splats.reading import read_splat

HALF_TURN_Z = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))


def original() -> Gaussians:
    """The Gaussians of tests/data/splats, read by plyfile, in float64."""
    v = PlyData.read(str(DATA / "original.ply"))["vertex"].data
    columns = lambda *names: torch.from_numpy(np.stack([v[name].astype(np.float64) for name in names], axis=1))  # noqa: E731
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    rest = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).transpose(1, 2)
    return Gaussians(
        columns("x", "y", "z"),
        quats / quats.norm(dim=1, keepdim=True),
        columns("scale_0", "scale_1", "scale_2").exp(),
        columns("opacity")[:, 0].sigmoid(),
        torch.cat([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], dim=1),
    )


def assert_alike(read: Gaussians, truth: Gaussians, *, centre: float, shape: float, opacity: float, dc: float, rest: float):
    """Largest differences: of centres in scene units, of covariances relative to each, of opacities and of coefficients."""
    read, truth = matched(read, truth)
    of, to = covariances(read), covariances(truth)
    apart = (of - to).flatten(1).norm(dim=1) / to.flatten(1).norm(dim=1)
    found = {
        "centre": (read.means - truth.means).abs().max(),
        "shape": apart.max(),
        "opacity": (read.opacities - truth.opacities).abs().max(),
        "dc": (read.colors[:, 0] - truth.colors[:, 0]).abs().max(),
        "rest": (read.colors[:, 1:] - truth.colors[:, 1:]).abs().max() if read.colors.shape[1] > 1 else torch.zeros(()),
    }
    allowed = {"centre": centre, "shape": shape, "opacity": opacity, "dc": dc, "rest": rest}
    assert all(found[name] <= allowed[name] for name in found), {name: float(value) for name, value in found.items()}


# What the bits of a format leave open, for coordinates within 2 units and harmonics within 0.5.
BYTE = 0.5 / 255
CONVERTED = {
    "packed.compressed.ply": (3, dict(centre=3e-3, shape=0.02, opacity=1.01 * BYTE, dc=0.008, rest=0.016)),
    "v4.spz": (3, dict(centre=1.3e-4, shape=0.08, opacity=1.01 * BYTE, dc=0.0132, rest=0.0665)),
    "v3.spz": (3, dict(centre=1.3e-4, shape=0.08, opacity=1.01 * BYTE, dc=0.0132, rest=0.0665)),
    "v2.sog": (3, dict(centre=1e-4, shape=0.06, opacity=2.01 * BYTE, dc=0.03, rest=0.03)),
    "level0.ksplat": (2, dict(centre=1e-6, shape=1e-5, opacity=2.01 * BYTE, dc=0.014, rest=1e-6)),
    "level1.ksplat": (2, dict(centre=8e-5, shape=2e-3, opacity=2.01 * BYTE, dc=0.014, rest=3e-4)),
    "level2.ksplat": (2, dict(centre=8e-5, shape=2e-3, opacity=2.01 * BYTE, dc=0.014, rest=0.004)),
}


@pytest.mark.parametrize("name", CONVERTED)
def test_what_converters_made_is_what_they_were_given(name):
    degree, allowed = CONVERTED[name]
    read = read_splat(DATA / name)
    assert read.gaussians.sh_degree == degree and not read.offset.any()
    assert read.gaussians.antialiased is (not name.endswith(".ksplat"))  # which has no place for it
    assert_alike(read.gaussians, original(), **allowed)


def test_a_compressed_ply_has_11_10_and_11_bits():
    read, truth = matched(read_splat(DATA / "packed.compressed.ply").gaussians, original())
    extent = truth.means.amax(dim=0) - truth.means.amin(dim=0)
    steps = torch.tensor([2047, 1023, 2047])
    assert ((read.means - truth.means).abs().amax(dim=0) <= 0.51 * extent / steps).all()


def test_the_ends_of_packed_harmonics_are_4(tmp_path):
    """Byte 0 is -4 and 255 is 4; between them a byte stands for the middle of its 256th part."""
    ply = PlyData.read(str(DATA / "packed.compressed.ply"))
    for value in range(32):
        ply["sh"].data["f_rest_16"][value] = (255 * value + 15) // 31
    ply.write(str(tmp_path / "a.ply"))
    stored = ply["sh"].data["f_rest_16"].astype(float)
    expected = np.where(stored == 0, -4, np.where(stored == 255, 4, ((stored + 0.5) / 256 - 0.5) * 8))
    assert read_splat(tmp_path / "a.ply").gaussians.colors[:, 2, 1].numpy() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("full", "partial"), [(6, []), (0, [3, 1, 20]), (4, [3, 2, 3])])
def test_a_ksplat_of_several_buckets(tmp_path, full, partial):
    cloud = a_cloud(degree=2)
    read = read_splat(write_ksplat(tmp_path / "a.ksplat", cloud, full=full, partial=partial)).gaussians
    truth = Gaussians(cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.colors.clamp(-1.77245, 1.77245))
    assert_alike(read, truth, centre=7e-5, shape=3e-3, opacity=1.01 * BYTE, dc=0.0071, rest=3e-4)


def test_splat_transform_turns_gltf_about_z():
    """It writes glTF, and no other format, in the axes of its engine; what is read is what the file says."""
    exact = dict(centre=1e-6, shape=1e-5, opacity=1e-6, dc=1e-6, rest=1e-6)
    assert_alike(read_splat(DATA / "plain.glb").gaussians, moved(original(), HALF_TURN_Z), **exact)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("degree", [0, 1, 4])
def test_spz_of_all_versions_before_zstd(tmp_path, version, degree):
    cloud = a_cloud(degree=degree)
    read = read_splat(write_spz(tmp_path / "a.spz", cloud, version, flags=version == 3)).gaussians
    assert read.sh_degree == degree and read.antialiased is (version == 3)
    # Bytes of x, y, z lose the angle where w is small.
    allowed = dict(centre=1e-3 if version == 1 else 1.3e-4, shape=0.08 if version == 3 else 0.3)
    assert_alike(read, cloud, **allowed, opacity=1.01 * BYTE, dc=0.0132, rest=0.004)


AXES = struct.pack("<III", 0xADBE0003, 4, 6)  # right, down, front, as in .ply


@pytest.mark.parametrize(
    ("system", "change"),
    [(6, (1, 1, 1)), (4, (1, -1, -1)), (8, (1, -1, 1)), (7, (-1, -1, 1))],  # RDF, RUB, RUF (mirrored), LUF
)
def test_an_spz_that_names_its_axes_is_brought_into_those_of_ply(tmp_path, system, change):
    cloud = a_cloud(degree=2)
    turn = torch.diag(torch.tensor([*change, 1.0], dtype=torch.float64))
    unknown = struct.pack("<II", 0x12340001, 3) + b"abc"
    extension = unknown + struct.pack("<III", 0xADBE0003, 4, system)
    read = read_splat(write_spz(tmp_path / "a.spz", cloud, 3, extension=extension)).gaussians
    assert_alike(read, moved(cloud, turn), centre=1.3e-4, shape=0.08, opacity=1.01 * BYTE, dc=0.0132, rest=0.004)


def test_an_spz_with_axes_that_are_swapped(tmp_path):
    """Right, front, up: y and z change places, and z its sign, on the way to right, down, front."""
    cloud = a_cloud(degree=1)
    extension = struct.pack("<III", 0xADBE0003, 4, 12)
    read = read_splat(write_spz(tmp_path / "a.spz", cloud, 3, extension=extension)).gaussians
    x, y, z = cloud.means.unbind(1)
    torch.testing.assert_close(read.means.double(), torch.stack([x, -z, y], dim=1), rtol=0, atol=1.3e-4)


def test_dot_splat(tmp_path):
    cloud = a_cloud(degree=0)
    cloud.quats[0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    read = read_splat(write_splat(tmp_path / "a.splat", cloud)).gaussians
    assert read.sh_degree == 0 and read.quats[0].tolist() == [1, 0, 0, 0]  # byte 128 is 0
    truth = Gaussians(cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.colors.clamp(-1.77245, 1.77245))
    assert_alike(read, truth, centre=1e-6, shape=0.03, opacity=1.01 * BYTE, dc=0.0071, rest=0)


def test_the_first_sog(tmp_path):
    cloud = a_cloud(degree=2)
    read = read_splat(write_first_sog(tmp_path / "a.sog", cloud)).gaussians
    assert read.sh_degree == 2 and not read.antialiased
    assert_alike(read, cloud, centre=1e-4, shape=0.05, opacity=0.01, dc=0.007, rest=0.0021)


@pytest.mark.parametrize("as_folder", [False, True])
def test_a_sog_in_a_folder(tmp_path, as_folder):
    folder = tmp_path / "scene"
    with zipfile.ZipFile(DATA / "v2.sog") as archive:
        archive.extractall(folder)
    read = read_splat(folder if as_folder else folder / "meta.json").gaussians
    whole = read_splat(DATA / "v2.sog").gaussians
    assert all(torch.equal(read.tensors[name], whole.tensors[name]) for name in read.tensors)
    (folder / "quats.webp").unlink()
    with pytest.raises(SceneError, match="lacks a file"):
        read_splat(folder / "meta.json")


def test_a_codebook_whose_first_entry_early_writers_left_out(tmp_path):
    folder = tmp_path / "scene"
    with zipfile.ZipFile(DATA / "v2.sog") as archive:
        archive.extractall(folder)
    meta = json.loads((folder / "meta.json").read_text())
    meta["scales"]["codebook"][0] = None
    (folder / "meta.json").write_text(json.dumps(meta))
    assert len(read_splat(folder).gaussians) == 32


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
@pytest.mark.parametrize("logarithms", [False, True])
def test_gltf_with_the_transform_of_its_nodes(tmp_path, name, logarithms):
    """Scales were logarithms in drafts until 2025."""
    cloud = a_cloud()
    rotation = roma.random_unitquat(dtype=torch.float64)
    node = {"rotation": rotation.tolist(), "scale": [2, 2, 2], "translation": [5, 0, -1]}
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3], transform[:3, 3] = 2 * roma.unitquat_to_rotmat(rotation), torch.tensor([5.0, 0, -1])
    exact = dict(centre=1e-5, shape=1e-4, opacity=1e-6, dc=1e-6, rest=1e-5)
    path = write_gltf(tmp_path / name, cloud, node=node, logarithms=logarithms)
    assert_alike(read_splat(path).gaussians, moved(cloud, transform), **exact)
    path = write_gltf(tmp_path / name, cloud, node={"matrix": transform.T.flatten().tolist()})
    assert_alike(read_splat(path).gaussians, moved(cloud, transform), **exact)


def test_gltf_with_spz_in_it(tmp_path):
    """Its drafts ask for spz to be unpacked to left, up, front: a half turn about y from its own right, up, back."""
    cloud = a_cloud(degree=1)
    packed = write_spz(tmp_path / "a.spz", cloud, 2).read_bytes()
    read = read_splat(write_gltf(tmp_path / "a.glb", cloud, packed=packed)).gaussians
    turn = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    assert_alike(read, moved(cloud, turn), centre=1.3e-4, shape=0.3, opacity=1.01 * BYTE, dc=0.0132, rest=0.004)


def test_content_decides_before_the_suffix(tmp_path):
    for name, wrong in {"v4.spz": "a.ply", "v3.spz": "b.splat", "plain.glb": "c.spz", "original.ply": "d.splat"}.items():
        (tmp_path / wrong).write_bytes((DATA / name).read_bytes())
        assert len(read_splat(tmp_path / wrong).gaussians) == 32


def test_a_compressed_ply_without_bounds_of_colours(tmp_path):
    """As written before 2024: colours are bytes over 0..1."""
    ply = PlyData.read(str(DATA / "packed.compressed.ply"))
    chunk = ply["chunk"].data
    rgb = [f"{side}_{c}" for side in ("min", "max") for c in "rgb"]
    kept = {name: chunk[name] for name in chunk.dtype.names if name not in rgb}
    packed = {name: ply["vertex"].data[name] for name in ply["vertex"].data.dtype.names}
    write_ply(tmp_path / "chunk.ply", kept)
    elements = [PlyData.read(str(tmp_path / "chunk.ply"))["vertex"].data, ply["vertex"].data]
    from plyfile import PlyElement

    PlyData([PlyElement.describe(elements[0], "chunk"), ply["vertex"]]).write(str(tmp_path / "a.ply"))
    read = read_splat(tmp_path / "a.ply").gaussians
    stored = np.stack([packed["packed_color"] >> shift & 255 for shift in (24, 16, 8)], axis=1) / 255
    assert read.colors[:, 0].numpy() * 0.28209479177387814 + 0.5 == pytest.approx(stored, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("a.las", "a point cloud, which is not read: train a splat on its photographs"),
        ("a.obj", "a mesh, which is not read: train a splat"),
        ("a.usdz", "an OpenUSD stage, which is not read: use the .ply or .spz"),
        ("a.lcc", "a scene of XGRIDS, which is not read: npx @playcanvas/splat-transform"),
        ("a.rad", "a scene of Spark in levels of detail, which is not read"),
        ("a.4dgs", "a splat that moves, which is not read: export one moment"),
        ("lod-meta.json", "a SOG in levels of detail, which is not read: npx"),
        ("a.txt", r"is no splat: expected a file that ends in \.ply, \.spz"),
    ],
)
def test_what_is_not_read_is_named_with_what_to_do(tmp_path, name, sentence):
    (tmp_path / name).write_bytes(b"something")
    with pytest.raises(SceneError, match=sentence):
        read_splat(tmp_path / name)
