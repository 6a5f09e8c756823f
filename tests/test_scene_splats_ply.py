"""Every kind of .ply that holds a splat gives its Gaussians; what is none says so in a sentence."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from splat_files import a_cloud, covariances, table_of, write_ply

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.reading import read_splat

C0 = 0.28209479177387814


def assert_equal(read: Gaussians, cloud: Gaussians, tolerance: float = 1e-5) -> None:
    assert {tensor.dtype for tensor in read.tensors.values()} == {torch.float32}
    assert all(tensor.is_contiguous() for tensor in read.tensors.values())
    for name in ("means", "scales", "opacities", "colors"):
        torch.testing.assert_close(read.tensors[name].double(), cloud.tensors[name], rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(covariances(read), covariances(cloud), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_ply_keeps_every_field(tmp_path, degree):
    cloud = a_cloud(degree=degree)
    read = read_splat(write_ply(tmp_path / "a.ply", table_of(cloud)))
    assert read.gaussians.sh_degree == degree and not read.offset.any() and not read.gaussians.antialiased
    assert_equal(read.gaussians, cloud)


@pytest.mark.parametrize("how", [{"text": True}, {"order": ">"}, {"order": "<"}])
@pytest.mark.parametrize("double", [False, True])
def test_text_and_any_byte_order_give_the_same(tmp_path, how, double):
    cloud = a_cloud(degree=1)
    columns = table_of(cloud, double) | {"nx": np.zeros(len(cloud), np.float32), "id": np.arange(len(cloud)).astype(np.uint8)}
    assert_equal(read_splat(write_ply(tmp_path / "a.ply", columns, **how)).gaussians, cloud)


def test_infinite_logits_are_opaque_and_clear_and_a_scale_of_zero_is_flat(tmp_path):
    columns = table_of(a_cloud())
    columns["opacity"][:4] = [np.inf, -np.inf, 400, -400]
    columns["scale_2"][4] = -np.inf
    read = read_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    assert read.opacities[:4].tolist() == [1, 0, 1, 0] and read.scales[4, 2] == 0


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("opacity", np.nan, "2 values of its opacities are NaN or infinite"),
        ("scale_1", np.inf, "2 values of its scales are NaN or infinite"),
        ("scale_1", 40.0, r"2 values of its scales lie outside 0 to 1e\+09 \(found .* to 2.35e\+17\)"),
        ("x", -np.inf, "2 values of its centres are NaN or infinite"),
        ("z", 1e30, "2 values of its distances from the middle lie outside"),
        ("f_rest_3", 1e30, "2 values of its colours lie outside"),
        ("rot_0", 1e30, "2 values of its quaternions' lengths are NaN or infinite"),
        ("rot_0", 1e15, "2 values of its quaternions' lengths lie outside"),
    ],
)
def test_what_cannot_be_drawn_is_named(tmp_path, field, value, sentence):
    columns = table_of(a_cloud())
    columns[field][[3, 7]] = value
    with pytest.raises(SceneError, match=sentence):
        read_splat(write_ply(tmp_path / "a.ply", columns))


def test_quaternions_of_no_length_are_refused(tmp_path):
    columns = table_of(a_cloud())
    for i in range(4):
        columns[f"rot_{i}"][5] = 0.0
    with pytest.raises(SceneError, match="1 values of its quaternions' lengths lie outside"):
        read_splat(write_ply(tmp_path / "a.ply", columns))


def test_the_filter_of_mip_splatting_adds_variance_and_keeps_the_mass(tmp_path):
    """A Gaussian convolved with another one: covariances add, and the integral, o s1 s2 s3, stays as it is."""
    cloud = a_cloud()
    deviations = np.random.default_rng(1).uniform(0.0, 0.2, len(cloud))
    deviations[0] = 0.0
    columns = table_of(cloud) | {"filter_3D": deviations.astype(np.float32)}
    read = read_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    added = torch.from_numpy(deviations**2)[:, None, None] * torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(covariances(read), covariances(cloud) + added, rtol=1e-5, atol=1e-9)
    mass, before = (g.opacities.double() * g.scales.double().prod(dim=1) for g in (read, cloud))
    torch.testing.assert_close(mass, before, rtol=1e-4, atol=0)
    assert read.opacities[0].item() == pytest.approx(cloud.opacities[0].item(), rel=1e-6)


def test_a_flat_gaussian_without_a_filter_stays_opaque(tmp_path):
    columns = table_of(a_cloud()) | {"filter_3D": np.zeros(24, np.float32)}
    columns["scale_2"][:] = -np.inf
    columns["filter_3D"][1] = 0.1
    read = read_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    assert read.opacities[0] > 0.04 and read.opacities[1] == 0  # all of the disc's mass is none of a ball's


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        ([], False),
        (["SplatRenderMode: mip"], True),
        (["SplatRenderMode: default"], False),
        (["SplatRenderMode: 2dgs"], False),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["SplatRenderMode: mip", "antialiased 0"], False),
        (["Exported from Brush", "Vertical axis: y", "SH degree: 3", "SplatRenderMode: mip"], True),
    ],
)
def test_the_header_says_how_the_splat_was_rasterized(tmp_path, comments, antialiased):
    path = write_ply(tmp_path / "a.ply", table_of(a_cloud()), comments=comments)
    assert read_splat(path).gaussians.antialiased is antialiased


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_colours_in_place_of_harmonics(tmp_path, kind):
    columns = {name: values for name, values in table_of(a_cloud(degree=0)).items() if not name.startswith("f_")}
    rgb = np.random.default_rng(2).uniform(0, 1, (24, 3))
    largest = 1.0 if kind == "f4" else float(np.iinfo(kind).max)
    columns |= {name: (rgb[:, i] * largest).astype(kind) for i, name in enumerate(("red", "green", "blue"))}
    read = read_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    assert read.sh_degree == 0
    assert (read.colors[:, 0].numpy() * C0 + 0.5) == pytest.approx(rgb, abs=1.01 / largest if kind != "f4" else 1e-6)


def test_fractions_far_above_one_are_no_colours(tmp_path):
    columns = {name: values for name, values in table_of(a_cloud(degree=0)).items() if not name.startswith("f_")}
    columns |= {name: np.full(24, 200.0, np.float32) for name in ("red", "green", "blue")}
    with pytest.raises(SceneError, match="red, green, blue are fractions up to 200; expected 0 to 1"):
        read_splat(write_ply(tmp_path / "a.ply", columns))


def test_harmonics_count_where_colours_stand_beside_them(tmp_path):
    cloud = a_cloud(degree=1)
    beside = {name: np.full(len(cloud), 255, np.uint8) for name in ("red", "green", "blue")}
    assert_equal(read_splat(write_ply(tmp_path / "a.ply", table_of(cloud) | beside)).gaussians, cloud)


def test_two_scales_are_flat_gaussians(tmp_path):
    cloud = a_cloud()
    columns = table_of(cloud)
    del columns["scale_2"]
    read = read_splat(write_ply(tmp_path / "a.ply", columns)).gaussians
    torch.testing.assert_close(read.scales[:, :2].double(), cloud.scales[:, :2], rtol=1e-5, atol=0)
    assert not read.scales[:, 2].any()


@pytest.mark.parametrize("far", [(5e5, 5.2e6, 120.0), (-1.2e7, 3.3e6, -4.1e6)])
def test_a_georeferenced_scene_loses_nothing(tmp_path, far):
    cloud = a_cloud()
    columns = table_of(cloud)
    columns |= {axis: cloud.means[:, i].numpy() + far[i] for i, axis in enumerate("xyz")}
    read = read_splat(write_ply(tmp_path / "a.ply", columns))
    exact = np.stack([columns[axis] for axis in "xyz"], axis=1)
    assert read.gaussians.means.dtype == torch.float32 and read.offset.tolist() == read.offset.round().tolist()
    assert np.abs(read.gaussians.means.double().numpy() + read.offset.numpy() - exact).max() < 2e-7
    assert read.gaussians.means.abs().max() < 4  # near the origin


def test_what_is_near_stays_where_it_is(tmp_path):
    """A scene whose middle is a hundred units away has lost nothing by that, and its cameras need not be moved."""
    columns = table_of(a_cloud(), double=True)
    columns["x"] += 100.0
    read = read_splat(write_ply(tmp_path / "a.ply", columns))
    assert not read.offset.any() and read.gaussians.means[:, 0].min() > 98


def described(tmp_path, **columns):
    return write_ply(tmp_path / "a.ply", {name: np.zeros(3, kind) for name, kind in columns.items()})


def test_what_is_no_splat_is_named(tmp_path):
    xyz = {"x": "f4", "y": "f4", "z": "f4"}
    with pytest.raises(SceneError, match=r"is a point cloud: it lacks the fields opacity, .*f_dc_2; .*ns-train splatfacto"):
        read_splat(described(tmp_path, **xyz, red="u1", green="u1"))
    face = PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))]), "face")
    vertices = PlyElement.describe(np.zeros(3, [(name, "f4") for name in "xyz"]), "vertex")
    PlyData([vertices, face]).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(SceneError, match=r"is a mesh: it lacks"):
        read_splat(tmp_path / "mesh.ply")
    columns = table_of(a_cloud())
    with pytest.raises(SceneError, match=r"holds Gaussians that move \(trbf_center\): export one moment"):
        read_splat(write_ply(tmp_path / "a.ply", columns | {"trbf_center": columns["x"]}))
    del columns["rot_3"]
    with pytest.raises(SceneError, match=r"is no whole 3D Gaussian splat: it lacks the field rot_3;"):
        read_splat(write_ply(tmp_path / "a.ply", columns))
    del columns["f_rest_7"]
    columns["rot_3"] = columns["rot_0"]
    with pytest.raises(SceneError, match=r"has 44 f_rest fields; .* 0, 9, 24, 45, 72"):
        read_splat(write_ply(tmp_path / "a.ply", columns))


def test_other_elements_beside_the_vertices_do_no_harm(tmp_path):
    """As Apple's SHARP and Niantic's tools write them."""
    cloud = a_cloud()
    write_ply(tmp_path / "plain.ply", table_of(cloud))
    vertices = PlyData.read(str(tmp_path / "plain.ply"))["vertex"]
    camera = PlyElement.describe(np.zeros(9, [("intrinsic", "f4")]), "intrinsic")
    for name, elements in {"after": [vertices, camera], "before": [camera, vertices]}.items():
        PlyData(elements).write(str(tmp_path / f"{name}.ply"))
        assert_equal(read_splat(tmp_path / f"{name}.ply").gaussians, cloud)


HEAD = "ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ((b"vertex 24", b"vertex 999999999999"), r"header describes 235,999,999,999,764 bytes of data, it holds 5,664"),
        ((b"vertex 24", b"vertex 23"), "header describes 5,428 bytes of data, it holds 5,664"),
        ((b"vertex 24", b"vertex -1"), "vertex has the count -1"),
        ((b"vertex 24", b"vertex " + b"9" * 400), "vertex has the count 9999"),
        ((b"element vertex 24", b"element vertex"), "not understood: element vertex"),
        ((b"property float x\n", b"property list uchar int x\n"), "vertex holds the list x, as meshes do|lacks the field x"),
        ((b"property float x\n", b"property float x\nproperty float x\n"), "not understood: property float x"),
        ((b"property float x\n", b"property half x\n"), "not understood: 'half'"),
        ((b"format binary_little_endian 1.0\n", b""), "the line of its format is missing"),
        ((b"binary_little", b"binary_middle"), "not understood: 'binary_middle_endian'"),
        ((b"end_header\n", b""), "a header from ply to end_header is missing"),
        ((b"ply\n", b"hello\n"), "header from ply to end_header is missing"),
        ((b"element vertex", b"element points"), "it has no vertices but points"),
    ],
)
def test_a_header_that_does_not_fit_the_file_is_refused(tmp_path, change, sentence):
    path = write_ply(tmp_path / "a.ply", table_of(a_cloud()))
    whole = path.read_bytes()
    assert change[0] in whole
    path.write_bytes(whole.replace(*change, 1))
    with pytest.raises(SceneError, match=sentence) as refusal:
        read_splat(path)
    assert "a.ply" in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_file_that_is_cut_or_too_long_is_refused(tmp_path):
    path = write_ply(tmp_path / "a.ply", table_of(a_cloud()))
    whole = path.read_bytes()
    for data in (whole[:-100], whole + b"1234"):
        path.write_bytes(data)
        with pytest.raises(SceneError, match="header describes 5,664 bytes of data"):
            read_splat(path)


def test_text_that_is_not_of_numbers_is_refused(tmp_path):
    path = write_ply(tmp_path / "a.ply", table_of(a_cloud(degree=0)), text=True)
    whole = path.read_text()
    path.write_text(whole[:-40] + "hello there")
    with pytest.raises(SceneError, match="its text holds something else than numbers"):
        read_splat(path)
    path.write_text(whole[:-60])
    with pytest.raises(SceneError, match=r"describes 336 numbers, it holds 3\d\d"):
        read_splat(path)
    path.write_text(whole + "1.0")
    with pytest.raises(SceneError, match=r"describes 336 numbers, it holds 337"):
        read_splat(path)
    path.write_text(whole.replace("vertex 24", "vertex 99999999999999"))
    with pytest.raises(SceneError, match=r"numbers, it holds .* characters"):
        read_splat(path)


def test_an_empty_scene_is_refused(tmp_path):
    with pytest.raises(SceneError, match="empty scene: it holds 0 Gaussians"):
        read_splat(write_ply(tmp_path / "a.ply", {name: values[:0] for name, values in table_of(a_cloud()).items()}))


def test_the_garden_is_read_as_before(garden_ply):
    """Against plyfile and torch, field by field."""
    read = read_splat(garden_ply)
    vertices = PlyData.read(str(garden_ply))["vertex"].data
    columns = [np.array(vertices[name]) for name in ("x", "y", "z")]
    assert torch.equal(read.gaussians.means, torch.from_numpy(np.stack(columns, axis=1))) and not read.offset.any()
    assert torch.equal(read.gaussians.opacities, torch.from_numpy(np.array(vertices["opacity"])).sigmoid())
    assert read.gaussians.colors[7, 2, 1] == vertices["f_rest_4"][7]  # the second of green's three
