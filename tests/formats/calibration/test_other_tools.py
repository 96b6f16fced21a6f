"""Calibrations of other tools: each form, values by hand, and broken files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.formats.calibration.files import RecordedCameras, read_calibration
from intercap_core.geometry.camera.transforms import rigid
from tests.helpers import other_calibrations as written

WORLD = np.array([[0.1, 0.2, 0.9], [-0.4, 0.3, 1.6], [0.0, 0.0, 0.0]])  # metres, z up


def looking_at_the_middle(angle_deg: float, coefficients: list[float]) -> written.View:
    """A camera 3 m from the z axis, 1.5 m above the floor, looking at the middle of the room."""
    centre = np.array([3 * np.cos(np.radians(angle_deg)), 3 * np.sin(np.radians(angle_deg)), 1.5])
    ahead = np.array([0, 0, 1.0]) - centre
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead])
    return written.View(
        (1280, 720),
        np.array([[901.5, 0, 639.25], [0, 903.25, 352.75], [0, 0, 1]]),
        np.array(coefficients + [0.0] * (8 - len(coefficients))),
        rigid(turn, -turn @ centre),
    )


VIEWS = {
    "left": looking_at_the_middle(-40, [-0.05, 0.15, -0.0001, 0.0006]),
    "front": looking_at_the_middle(10, [0.08, -0.14, 0.0003, -0.0005]),
    "right": looking_at_the_middle(120, [0.0, 0.0, 0.0, 0.0]),
}
Write = Callable[[Path], Path]
FORMS: dict[str, tuple[Write, float | None]] = {
    "pose2sim": (lambda folder: written.write_pose2sim(folder, VIEWS), None),
    "pose2sim-folder": (lambda folder: written.write_pose2sim(folder, VIEWS).parent, None),
    "qualisys": (lambda folder: written.write_qualisys(folder, VIEWS), None),
    "qualisys-folder": (lambda folder: written.write_qualisys(folder, VIEWS).parent, None),
    "anipose": (lambda folder: written.write_anipose(folder, VIEWS), 0.001),
    "easymocap": (lambda folder: written.write_easymocap(folder, VIEWS), None),
    "easymocap-sizes": (lambda folder: written.write_easymocap(folder, VIEWS, sizes=True), None),
    "colmap-text": (
        lambda folder: written.write_colmap(folder, VIEWS, metres=0.37, binary=False), 0.37,
    ),
    "colmap-binary": (
        lambda folder: written.write_colmap(folder, VIEWS, metres=0.37, binary=True), 0.37,
    ),
    "nerfstudio": (lambda folder: written.write_nerfstudio(folder, VIEWS, metres=2.5), 2.5),
    "nerfstudio-folder": (
        lambda folder: written.write_nerfstudio(folder, VIEWS, metres=2.5).parent, 2.5,
    ),
}  # fmt: skip
RECORDED = RecordedCameras(tuple(VIEWS), lambda name: VIEWS[name].size)


@pytest.mark.parametrize("form", FORMS)
def test_each_form_gives_the_same_cameras(tmp_path, form):
    write, scale = FORMS[form]
    calibration = read_calibration(write(tmp_path), RECORDED, scale=scale)
    extrinsics = calibration.extrinsics
    assert set(calibration.cameras) == set(extrinsics.master_from_colour) == set(VIEWS)
    assert np.array_equal(extrinsics.master_from_colour[extrinsics.master], np.eye(4))
    in_master = WORLD @ extrinsics.master_from_world[:3, :3].T + extrinsics.master_from_world[:3, 3]
    for name, view in VIEWS.items():
        own = np.linalg.inv(extrinsics.master_from_colour[name])
        seen = calibration.cameras[name].colour.project(in_master @ own[:3, :3].T + own[:3, 3])
        expected = cv2.projectPoints(
            WORLD, view.turn, view.shift, view.matrix, view.distortion[:5]
        )[0][:, 0]
        # EasyMocap writes six digits: a millionth of a radian is a thousandth of a pixel.
        assert np.abs(seen - expected).max() < (5e-3 if "easy" in form else 1e-6)
        assert (calibration.cameras[name].colour.width, view.size[1]) == (1280, 720)
        assert calibration.cameras[name].depth is None and calibration.cameras[name].fps is None


def test_pose2sim_by_hand(tmp_path):
    """A quarter turn about x: what is up in the world (z) is up (-y) in the image."""
    path = tmp_path / "Calib.toml"
    path.write_text(
        '[int_cam01_img]\nname = "int_cam01_img"\nsize = [ 1088.0, 1920.0]\n'
        "matrix = [ [ 1600.0, 0.0, 544.0], [ 0.0, 1600.0, 960.0], [ 0.0, 0.0, 1.0]]\n"
        "distortions = [ 0.0, 0.0, 0.0, 0.0]\n"
        f"rotation = [ {np.pi / 2}, 0.0, 0.0]\ntranslation = [ 0.0, 1.0, 4.0]\nfisheye = false\n\n"
        "[metadata]\nadjusted = false\nerror = 0.0\n"
    )
    calibration = read_calibration(path, RecordedCameras(("cam01",)))
    world = calibration.extrinsics.master_from_world
    # x_camera = R x + T: (0.5, 2, 1.5) goes to (0.5, -1.5 + 1, 2 + 4)
    np.testing.assert_allclose(world @ [0.5, 2, 1.5, 1], [0.5, -0.5, 6, 1], atol=1e-12)
    seen = calibration.cameras["cam01"].colour.project((world @ [0.5, 2, 1.5, 1])[:3])
    np.testing.assert_allclose(seen, [544 + 1600 * 0.5 / 6, 960 - 1600 * 0.5 / 6], atol=1e-9)


def test_qualisys_is_read_as_pose2sim_converts_it(tmp_path):
    """Numbers of the first camera of Pose2Sim's demonstration, and its Calib_qualisys.toml."""
    path = tmp_path / "Calib.qca.txt"
    path.write_text(
        '<calibration><cameras><camera model="none" serial="cam01">'
        '<fov_video bottom="1919" left="0" right="1087" top="0"/>'
        '<transform r11="0.5536380477336265" r12="0.8046719867383512" r13="0.2144479094331626" '
        'r21="-0.4345300743838753" r22="0.05946489349975602" r23="0.8986921279821063" '
        'r31="0.7104002579937896" r32="-0.5907342212870501" r33="0.3825762057979294" '
        'x="1460.2323709212087" y="-1909.1590482454608" z="1896.5058524092062"/>'
        '<intrinsic centerPointU="34110.316406" centerPointV="60680.792969" '
        'focalLengthU="107599.671875" focalLengthV="107588.828125" radialDistortion1="-0.046183" '
        'radialDistortion2="0.139983" tangentalDistortion1="0.000608" '
        'tangentalDistortion2="0.00069"/></camera></cameras></calibration>'
    )
    calibration = read_calibration(path, RecordedCameras(("cam01",)))
    world = calibration.extrinsics.master_from_world
    rotation = Rotation.from_matrix(world[:3, :3]).as_rotvec()
    np.testing.assert_allclose(rotation, [1.68827548, 1.04832205, -0.41955852], atol=1e-8)
    np.testing.assert_allclose(world[:3, 3], [0.32110489, 0.95633206, 2.89071305], atol=1e-8)
    lens = calibration.cameras["cam01"].colour
    assert (lens.width, lens.height) == (1088, 1920)
    expected = [1681.244873046875, 1681.075439453125, 532.97369384375, 948.137390140625]
    np.testing.assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], expected)
    np.testing.assert_allclose(lens.distortion[:4], [-0.046183, 0.139983, 0.000608, 0.00069])


def test_nerfstudio_by_hand(tmp_path):
    """OpenGL's axes: a camera at z = 5 with the world's axes looks down, y is up in its image."""
    frame = np.eye(4)
    frame[2, 3] = 5
    content = {
        "camera_model": "OPENCV", "fl_x": 500.0, "fl_y": 400.0, "cx": 320.0, "cy": 240.0,
        "w": 640, "h": 480,
        "frames": [{"file_path": "./images/top.jpeg", "transform_matrix": frame.tolist()}],
    }  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    calibration = read_calibration(tmp_path, RecordedCameras(("top",)), scale=1.0)
    point = (calibration.extrinsics.master_from_world @ [1, 2, 0, 1])[:3]
    np.testing.assert_allclose(point, [1, -2, 5])
    seen = calibration.cameras["top"].colour.project(point)
    # Its pixel centres are at halves, ours at whole numbers.
    np.testing.assert_allclose(seen, [320 + 500 / 5 - 0.5, 240 - 400 * 2 / 5 - 0.5], atol=1e-9)


def test_colmap_by_hand(tmp_path):
    """The documentation's first image: its centre is -R^t T."""
    (tmp_path / "cameras.txt").write_text(
        "# Camera list\n1 SIMPLE_RADIAL 3072 2304 2559.69 1536 1152 -0.0218531\n"
    )
    (tmp_path / "images.txt").write_text(
        "# Image list\n"
        "1 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180141.JPG\n\n"
        "2 0.851773 0.0165051 0.503764 -0.142941 0.262566 1.02973 3.74354 1 P1180142.JPG\n"
        "1190.83 663.957 23056 1258.77 640.354 59070\n"
    )
    calibration = read_calibration(tmp_path, scale=0.5)
    world = calibration.extrinsics.master_from_world
    turn = Rotation.from_quat([0.0165051, 0.503764, -0.142941, 0.851773]).as_matrix()
    np.testing.assert_allclose(world[:3, 3], 0.5 * np.array([-0.737434, 1.02973, 3.74354]))
    centre = -turn.T @ world[:3, 3]
    np.testing.assert_allclose(world @ [*centre, 1], [0, 0, 0, 1], atol=1e-12)
    apart = calibration.extrinsics.master_from_colour["P1180142"][:3, 3]
    np.testing.assert_allclose(apart, [-0.5, 0, 0], atol=1e-9)
    lens = calibration.cameras["P1180141"].colour
    x, y = 0.2, -0.1
    bend = 1 - 0.0218531 * (x * x + y * y)
    expected = [2559.69 * x * bend + 1536 - 0.5, 2559.69 * y * bend + 1152 - 0.5]
    np.testing.assert_allclose(lens.project(np.array([x, y, 1.0])), expected, atol=1e-9)


def test_the_path_of_an_image_names_its_camera(tmp_path):
    written.write_colmap(tmp_path, VIEWS, metres=1.0, binary=True, image="shots/{}/0001.jpg")
    assert set(read_calibration(tmp_path, RECORDED, scale=1.0).cameras) == set(VIEWS)
    written.write_colmap(tmp_path, VIEWS, metres=1.0, binary=True, image="{}.jpg")
    assert set(read_calibration(tmp_path, scale=1.0).cameras) == set(VIEWS)


def edit(old: str, new: str, file: str = "") -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        target = path / file if file else path
        text = target.read_text()
        assert old in text
        target.write_text(text.replace(old, new))

    return apply


def change(**entries: object) -> Callable[[Path], None]:
    """Set entries of a transforms.json's second frame; ... removes one."""

    def apply(path: Path) -> None:
        content = json.loads(path.read_text())
        for key, value in entries.items():
            if value is ...:
                del content["frames"][1][key]
            else:
                content["frames"][1][key] = value
        path.write_text(json.dumps(content))

    return apply


def cut(file: str, count: int) -> Callable[[Path], None]:
    return lambda path: (path / file).write_bytes((path / file).read_bytes()[:count]) and None


def endless_points(path: Path) -> None:
    """A number of points, after the name of the first image, above all memory."""
    images = path / "images.bin"
    before, end, after = images.read_bytes().partition(b".png\0")
    images.write_bytes(before + end + b"\xff" * 8 + after[8:])


def exchange(one: str, other: str, file: str) -> Callable[[Path], object]:
    """Exchange two names everywhere in a file."""

    def apply(path: Path) -> None:
        parts = (path / file).read_text().split(one)
        (path / file).write_text(other.join(part.replace(other, one) for part in parts))

    return apply


def remove(file: str) -> Callable[[Path], None]:
    return lambda path: (path / file).unlink()


def twice(path: Path) -> None:
    """A second image of the camera left, half a metre away."""
    lines = (path / "images.txt").read_text().splitlines()
    words = lines[3].split()
    words[0], words[7] = "9", str(float(words[7]) + 0.5 / 0.37)
    (path / "images.txt").write_text("\n".join([*lines, " ".join(words), ""]))


def as_utf16_with_document_type(path: Path) -> None:
    text = path.read_text().replace("ASCII", "UTF-16")
    path.write_text(text.replace("<calibration>", "<!DOCTYPE a><calibration>"), encoding="utf-16")


FAULTS = [
    ("pose2sim", edit("fisheye = false", "fisheye = true"), "camera 'left': is calibrated as a fi"),
    ("pose2sim", edit("translation", "shift"), "camera 'left': has no translation"),
    (
        "pose2sim",
        edit('[front]\nname = "front"', '["fr ont"]'),
        "'fr ont' has a name that no file can have",
    ),
    (
        "pose2sim",
        edit('[front]\nname = "front"', '[a]\nname = "../front"'),
        "'../front' has a name that no file can have",
    ),
    ("pose2sim", edit('"front"', '"left"'), "two cameras are named 'left'"),
    ("pose2sim", edit("[left]", "[left"), "is not valid TOML"),
    ("qualisys", edit("</cameras>", ""), "is no XML"),
    (
        "qualisys",
        edit("<calibration>", "<!DOCTYPE a><calibration>"),
        "declares a document type",
    ),
    ("qualisys", as_utf16_with_document_type, "declares a document type"),
    ("qualisys", edit("<calibration>", "<calibration><!-- by hand --><![CDATA[ ]]>"), None),
    ("qualisys", edit('z="', 'height="'), "camera 'left': transform has"),
    (
        "qualisys",
        edit('right="1287"', 'right="1287.5"'),
        "expected width and height",
    ),
    ("pose2sim", edit("901.5", "nan"), "camera_matrix is .* expected finite numbers"),
    ("easymocap", remove("extri.yml"), "has no extri.yml"),
    ("easymocap", edit("K_front", "L_front", "intri.yml"), "camera 'front': has no K_front"),
    ("easymocap", edit("dist_left", "bend_left", "intri.yml"), "camera 'left': has no dist_left"),
    ("easymocap", edit("Rot_front", "Rot_left", "extri.yml"), "'Rot_left' is given twice"),
    (
        "easymocap",
        exchange("Rot_front", "Rot_left", "extri.yml"),
        "R_left and Rot_left are two rota",
    ),
    ("easymocap", edit("names:", "name:", "intri.yml"), "expected 'names'"),
    ("colmap-text", edit("FULL_OPENCV", "OPENCV_FISHEYE", "cameras.txt"), "OPENCV_FISHEYE cannot"),
    ("colmap-text", edit("FULL_OPENCV", "OPENCV", "cameras.txt"), "has 12 parameters, expected 8"),
    ("colmap-text", edit("1280 720", "wide 720", "cameras.txt"), "cameras.txt, line 3: expected"),
    ("colmap-text", edit(" 2 front", " 8 front", "images.txt"), "is of camera 8, which camera"),
    ("colmap-text", edit("left/frame", "left/", "images.txt"), None),
    ("colmap-text", twice, "left/frame_000001.png are 0.5 m and 0 degrees apart"),
    ("colmap-binary", cut("images.bin", 200), "images.bin: is cut off"),
    ("colmap-binary", endless_points, "images.bin: is cut off"),
    ("nerfstudio", change(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR' cannot be repres"),
    ("nerfstudio", change(is_fisheye=True), "is_fisheye cannot be represented"),
    ("nerfstudio", change(k4=0.01), "frame 1 .*: k4 is 0.01"),
    ("nerfstudio", change(fl_x=...), "frame 1 .*: has no fl_x"),
    ("nerfstudio", change(file_path=...), "frame 1: has no file_path"),
    ("nerfstudio", change(transform_matrix=np.diag([2, 1, 1, 1]).tolist()), "is no rigid 4x4"),
]


@pytest.mark.parametrize(("form", "fault", "words"), FAULTS)
def test_broken_files_are_refused(tmp_path, form, fault, words):
    write, scale = FORMS[form]
    path = write(tmp_path)
    fault(path)
    if words is None:  # harmless: the camera is in the path's folder
        assert set(read_calibration(path, RECORDED, scale=scale).cameras) == set(VIEWS)
        return
    with pytest.raises(UserError, match=words) as raised:
        read_calibration(path, RECORDED, scale=scale)
    assert str(tmp_path) in str(raised.value)


@pytest.mark.parametrize("form", ["anipose", "colmap-text", "colmap-binary", "nerfstudio"])
def test_files_without_a_unit_need_a_scale(tmp_path, form):
    write, scale = FORMS[form]
    path = write(tmp_path)
    with pytest.raises(UserError, match="state metres for one of its units in column calibration_"):
        read_calibration(path, RECORDED)
    with pytest.raises(UserError, match=r"a camera is .* m from the origin"):
        read_calibration(path, RECORDED, scale=1000 * scale)
    with pytest.raises(UserError, match="all its cameras lie within"):
        read_calibration(path, RECORDED, scale=scale / 1000)


def test_millimetres_need_a_scale(tmp_path):
    path = written.write_anipose(tmp_path, VIEWS)
    path.write_text(path.read_text().replace("translation", "fisheye = false\ntranslation"))
    with pytest.raises(UserError, match=r"state the unit in column calibration_scale.*0\.001"):
        read_calibration(path, RECORDED)
    assert set(read_calibration(path, RECORDED, scale=0.001).cameras) == set(VIEWS)


def test_cameras_without_recordings_are_refused(tmp_path):
    path = written.write_pose2sim(tmp_path, VIEWS)
    with pytest.raises(UserError, match="left, front, right, the recordings are of k1, k2: none"):
        read_calibration(path, RecordedCameras(("k1", "k2")))
    # The names of Anipose's tables are used if the recordings have them.
    tables = RecordedCameras(("cam_0", "cam_1", "cam_2"))
    anipose = read_calibration(written.write_anipose(tmp_path, VIEWS), tables, scale=0.001)
    assert list(anipose.cameras) == ["cam_0", "cam_1", "cam_2"]


def test_easymocap_without_any_size(tmp_path):
    path = written.write_easymocap(tmp_path, VIEWS)
    with pytest.raises(UserError, match="has no W_left and H_left, and no recording"):
        read_calibration(path, RecordedCameras(("left",)))


def test_parts_and_ambiguous_folders_are_refused(tmp_path):
    written.write_easymocap(tmp_path, VIEWS)
    with pytest.raises(UserError, match="is a part of a calibration; name its folder"):
        read_calibration(tmp_path / "intri.yml", RECORDED)
    other = tmp_path / "other"
    other.mkdir()
    path = written.write_pose2sim(other, VIEWS)
    shutil.copy(path, other / "Config.toml")
    with pytest.raises(UserError, match=r"holds Calib_scene.toml, Config.toml; name the one"):
        read_calibration(other, RECORDED)
    path.write_text("[project]\nframe_rate = 30\n")
    with pytest.raises(UserError, match="not their configuration"):
        read_calibration(path, RECORDED)
