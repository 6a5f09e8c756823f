"""Files that are damaged, cut off, or made to ask for all memory: each is refused in one sentence, before it does harm."""

from __future__ import annotations

import gzip
import io
import json
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
import torch
import zstandard
from fuzzing import changed_bytes, survive
from PIL import Image
from splat_files import DATA, a_cloud, table_of, webp, write_first_sog, write_gltf, write_ply, write_splat, write_spz

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.splats.reading import read_splat

FILES = ["packed.compressed.ply", "v4.spz", "v3.spz", "v2.sog", "plain.glb", "level0.ksplat", "level1.ksplat", "level2.ksplat"]


def refused(path, sentence: str) -> None:
    with pytest.raises(SceneError, match=sentence) as refusal:
        read_splat(path)
    assert "\n" not in str(refusal.value) and path.name in str(refusal.value)


@pytest.mark.parametrize("name", FILES)
def test_any_change_is_taken_or_refused_in_a_sentence(tmp_path, name):
    whole = (DATA / name).read_bytes()
    path = tmp_path / name

    def use(data: bytes) -> None:
        path.write_bytes(data)
        read = read_splat(path).gaussians
        assert all(torch.isfinite(tensor).all() for tensor in read.tensors.values())

    survive(changed_bytes(whole), use, SceneError, examples=100)


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_cut_off_is_refused_wherever_it_is_cut(tmp_path, name):
    whole = (DATA / name).read_bytes()
    path = tmp_path / name
    for length in (0, 1, 5, 17, 40, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        refused(path, "is|has|cannot|lies|holds")


def within(megabytes: float, path, sentence: str) -> None:
    tracemalloc.start()
    refused(path, sentence)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < megabytes * 1e6


def test_an_spz_cannot_ask_for_all_memory(tmp_path):
    path = tmp_path / "a.spz"
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000_000, 3, 12, 0, 0)
    path.write_bytes(gzip.compress(header + bytes(1000)))
    within(5, path, "is cut off: 4,000,000,000 Gaussians need")
    path.write_bytes(gzip.compress(header + bytes(200_000_000), 6))
    within(80, path, r"say|unpack to")
    version_4 = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 4_000_000_000, 0, 12, 0, 5, 32)
    path.write_bytes(version_4 + bytes(80) + bytes(1000))
    within(5, path, "unpack to 80,000,000,000, more than 100 times as much")
    # A frame that unpacks to more than its part of the table of contents says.
    n = 10
    frames = [zstandard.compress(bytes(n * size * (1000 if i == 2 else 1))) for i, size in enumerate((9, 1, 3, 3, 4))]
    table = b"".join(struct.pack("<QQ", len(f), n * size) for f, size in zip(frames, (9, 1, 3, 3, 4), strict=True))
    path.write_bytes(struct.pack("<4sIIBBBBI12x", b"NGSP", 4, n, 0, 12, 0, 5, 32) + table + b"".join(frames))
    within(5, path, "unpacks to another size than the 30 bytes")


def test_an_spz_that_says_something_else_than_it_is(tmp_path):
    path = write_spz(tmp_path / "a.spz", a_cloud(degree=0), 2)
    whole = gzip.decompress(path.read_bytes())
    for change, sentence in {
        (4, b"\x09"): "is a .spz of version 9; versions 1 to 4 are read",
        (12, b"\x07"): "harmonics of degree 7",
        (13, b"\x20"): "32 bits of fraction",
        (8, b"\x17"): "damaged: 23 Gaussians need",
        (8, b"\x19"): "cut off: 25 Gaussians need",
        (0, b"PNG "): r"is packed with gzip and no \.spz",
    }.items():
        at, value = change if isinstance(change, tuple) else (0, b"")
        path.write_bytes(gzip.compress(whole[:at] + value + whole[at + len(value) :]))
        refused(path, sentence)
    extension = struct.pack("<III", 0xADBE0003, 4, 99)
    refused(write_spz(path, a_cloud(degree=0), 3, extension=extension), "its coordinate system has the number 99")
    path.write_bytes(gzip.compress(whole) + b"more")
    refused(path, "is damaged")


def sog(tmp_path, change) -> None:
    """The SOG of the tests' data with its meta.json and files changed by `change(meta, files)`."""
    with zipfile.ZipFile(DATA / "v2.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files.pop("meta.json"))
    change(meta, files)
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(name, data)
    return tmp_path / "a.sog"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda meta, files: meta.update(version=3), "version 3; 1 and 2 are known"),
        (lambda meta, files: meta.update(count=33_000_000), "means has .* pixels for 33,000,000 Gaussians"),
        (lambda meta, files: meta.update(count=-1), "count is -1, not a number of Gaussians"),
        (lambda meta, files: meta.update(count=True), "count is True, not a number of Gaussians"),
        (lambda meta, files: meta.pop("quats"), "lacks quats.files"),
        (lambda meta, files: meta["means"].update(mins=[0, 0]), "means.mins has 2 numbers, not 3"),
        (lambda meta, files: meta["means"].update(maxs=[0, 0, "x"]), "means.maxs holds x, which is no number"),
        (lambda meta, files: meta["means"].update(maxs=[0, 0, 1e308]), r"means.maxs holds 1e\+308, which is no number"),
        (lambda meta, files: meta["means"].update(maxs=[0, 0, 500]), "NaN or infinite"),
        (lambda meta, files: meta["sh0"].update(codebook=[1.0]), "sh0.codebook has 1 numbers, not 256"),
        (lambda meta, files: meta["quats"].update(files=["../quats.webp"]), "is no name of a file in the same folder"),
        (lambda meta, files: meta["quats"].update(files=["nothing.webp"]), "nothing.webp.* is missing"),
        (lambda meta, files: files.update({"quats.webp": b"RIFF"}), "quats.webp is no WebP"),
        (
            lambda meta, files: files.update({"quats.webp": bytes(100_000_000)}),
            "quats.webp says that it unpacks to 100,000,000",
        ),
        (
            lambda meta, files: files.update({"quats.webp": webp(np.zeros((4000, 4000, 4), np.uint8))}),
            "unpack to 64,000,000, more than 100 times",
        ),
        (
            lambda meta, files: files.update({"quats.webp": webp(np.zeros((8, 8, 4), np.uint8))}),
            "32 of its quaternions do not say which part is the largest",
        ),
        (
            lambda meta, files: files.update({"shN_labels.webp": webp(np.full((8, 8, 4), 255, np.uint8))}),
            "shN asks for entry 65,535 of",
        ),
        (
            lambda meta, files: files.update({"shN_centroids.webp": webp(np.full((2, 100, 4), 255, np.uint8))}),
            "shN has a palette 100 wide",
        ),
    ],
)
def test_a_sog_that_does_not_fit_together(tmp_path, change, sentence):
    within(120, sog(tmp_path, change), sentence)


def test_what_is_no_sog(tmp_path):
    path = tmp_path / "a.sog"
    path.write_bytes(b"hello")
    refused(path, "cannot be read as SOG")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("other.txt", "hello")
    refused(path, "it holds no meta.json")
    for text in ("[" * 100_000, "{", "[]", '{"version": 2}', "\xff"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("meta.json", text)
        refused(path, "meta.json")
    image = io.BytesIO()
    Image.new("RGB", (4, 4)).save(image, "PNG")
    refused(sog(tmp_path, lambda meta, files: files.update({"quats.webp": image.getvalue()})), "quats.webp is no WebP")


def changed_gltf(tmp_path, change) -> None:
    path = write_gltf(tmp_path / "a.gltf", a_cloud(degree=1))
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    return path


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda meta: meta.pop("asset"), "describes no asset"),
        (lambda meta: meta["scenes"][0].update(nodes=[7]), "nodes has no entry 7"),
        (lambda meta: meta["nodes"][1].update(children=[0]), "nodes are nested in themselves"),
        (lambda meta: meta["nodes"][0].update(scale=[1, 2, 1]), "stretches or shears"),
        (lambda meta: meta["nodes"][0].update(scale=[0, 0, 0]), "of finite numbers"),
        (lambda meta: meta["nodes"][0].update(matrix=[1, 2]), r"matrix of a node is \[1, 2\], not 16 numbers"),
        (lambda meta: meta["nodes"][0].update(rotation="x"), "rotation of a node is x, not 4 numbers"),
        (lambda meta: meta["meshes"][0]["primitives"][0].pop("extensions"), "no primitive of it has KHR_gaussian_splatting"),
        (lambda meta: meta["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "its Gaussians lack POSITION"),
        (lambda meta: meta["accessors"][0].update(count=10**12), "asks for 1,000,000,000,000 rows of a view of 288 bytes"),
        (lambda meta: meta["accessors"][0].update(count=-1), "asks for -1 rows"),
        (lambda meta: meta["accessors"][0].update(count=10**400), "cannot be read as glTF"),
        (lambda meta: meta["accessors"][0].update(componentType=1), "KeyError: 1"),
        (lambda meta: meta["accessors"][0].update(type="VEC4"), "accessor 0 is of the type VEC4"),
        (lambda meta: meta["accessors"][0].update(count=5), "its attributes have 5 and 24 rows"),
        (lambda meta: meta["bufferViews"][0].update(byteLength=10**9), "reaches to byte 1,000,000,000 of"),
        (lambda meta: meta["bufferViews"][0].update(byteStride=-4), "asks for 24 rows"),
        (lambda meta: meta["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}), "packed with EXT_meshopt"),
        (lambda meta: meta["accessors"][0].pop("bufferView"), "accessor 0 is sparse or has no bytes of its own"),
        (
            lambda meta: meta["meshes"][0]["primitives"][0]["extensions"].update(KHR_draco_mesh_compression={}),
            "packed with KHR_draco_mesh_compression, which is not read",
        ),
        (lambda meta: meta["buffers"][0].update(uri="../../etc/passwd"), "lies elsewhere"),
        (lambda meta: meta["buffers"][0].update(uri="/etc/passwd"), "lies elsewhere"),
        (lambda meta: meta["buffers"][0].update(uri="https://example.org/a.bin"), "lies elsewhere"),
        (lambda meta: meta["buffers"][0].update(uri="b.bin"), r"its file b\.bin cannot be opened"),
        (lambda meta: meta["buffers"][0].update(uri="data:,%%%"), "is no base64"),
        (lambda meta: meta["buffers"][0].pop("uri"), "buffer 0 is missing"),
    ],
)
def test_a_gltf_that_does_not_fit_together(tmp_path, change, sentence):
    within(20, changed_gltf(tmp_path, change), sentence)


def test_gltf_in_ways_that_are_not_read(tmp_path):
    def described(**what):
        return lambda meta: meta["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"].update(what)

    refused(changed_gltf(tmp_path, described(colorSpace="lin_rec709_display")), "colours are lin_rec709_display")
    refused(changed_gltf(tmp_path, described(kernel="sphere")), "kernel is sphere; ellipse is read")
    (tmp_path / "b.gltf").write_text("[" * 100_000)
    refused(tmp_path / "b.gltf", "cannot be read as glTF")


def test_a_splat_of_no_whole_number_of_gaussians(tmp_path):
    path = write_splat(tmp_path / "a.splat", a_cloud(degree=0))
    path.write_bytes(path.read_bytes()[:-1])
    refused(path, "767 bytes are no multiple of 32")
    path.write_bytes(b"")
    refused(path, "holds 0 Gaussians")
    path.write_bytes(np.random.default_rng(0).bytes(3200))
    refused(path, "NaN or infinite|lie outside")


@pytest.mark.parametrize(
    ("at", "value", "sentence"),
    [
        (1, b"\x02", "is a .ksplat of version 0.2 and level 1"),
        (20, b"\x05", "version 0.1 and level 5"),
        (4, b"\xff\xff\xff\xff", "have no room for 4,294,967,295 sections"),
        (16, b"\xff\xff\xff\x00", "its header has 16,777,215 Gaussians, its sections 32"),
        (4096, b"\xff\xff\xff\x00", "a section has 16,777,215 of 32 Gaussians"),
        (4100, b"\xff\xff\xff\xff", "a section needs .* bytes, the file has"),
        (4108, b"\xff\xff\xff\xff", "a section needs .* bytes, the file has"),
        (4132, b"\x00\x00\x00\x00", "its buckets have no room for the 32 Gaussians"),
        (4136, b"\x09", "harmonics of degree 9"),
    ],
)
def test_a_ksplat_that_does_not_fit_together(tmp_path, at, value, sentence):
    whole = (DATA / "level1.ksplat").read_bytes()
    path = tmp_path / "a.ksplat"
    path.write_bytes(whole[:at] + value + whole[at + len(value) :])
    within(5, path, sentence)


def test_folders_and_files_that_are_not_there(tmp_path):
    refused(tmp_path / "nothing.ply", "cannot be opened")
    (tmp_path / "folder.ply").mkdir()
    refused(tmp_path / "folder.ply", "lacks a file or cannot be opened")


def test_a_first_sog_with_wild_values(tmp_path):
    cloud = a_cloud(degree=1)
    path = write_first_sog(tmp_path / "a.sog", cloud)
    read_splat(path)
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["scene/meta.json"])
    meta["scales"]["maxs"] = [400.0] * 3
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {**files, "scene/meta.json": json.dumps(meta).encode()}.items():
            archive.writestr(name, data)
    refused(path, "values of its scales are NaN or infinite")


def test_a_compressed_ply_that_does_not_fit_together(tmp_path):
    whole = (DATA / "packed.compressed.ply").read_bytes()
    path = tmp_path / "a.ply"
    for change, sentence in {
        (b"element chunk 1", b"element chunk 2"): "32 packed vertices need 1 chunks, not 2",
        (b"element chunk", b"element other"): "its packed vertices have no chunks",
        (b"uint packed_scale", b"uint packed_other"): "of a compressed .ply it lacks packed_scale",
        (b"float min_scale_x", b"float min_other_x"): "of a compressed .ply it lacks min_scale_x",
        (b"element sh 32", b"element sh 31"): "header describes 1,979 bytes of data, it holds 2,024",
        (b"uchar f_rest_9\n", b"char f_rest_9\n"): "its harmonics are not bytes of its 32 vertices",
        (b"f_rest_44", b"f_other_4"): "has 44 f_rest fields",
    }.items():
        assert change[0] in whole
        path.write_bytes(whole.replace(*change))
        refused(path, sentence)


def test_a_plain_ply_is_not_hurt_by_all_this(tmp_path):
    assert len(read_splat(write_ply(tmp_path / "a.ply", table_of(a_cloud()))).gaussians) == 24
