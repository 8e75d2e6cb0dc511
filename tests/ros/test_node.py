"""The node of ROS 2: images and cameras it takes, messages it gives, its files; rclpy if there."""

import ast
import sys
import xml.etree.ElementTree as ET
from array import array
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from cvo_edge import Odometer, UsageError, open_source
from cvo_edge.input.decoding import decode_image
from cvo_edge.output.messages import Placement, ros_messages
from cvo_edge.output.records import header_of

ROS = Path(__file__).resolve().parents[2] / "ros"
sys.path.append(str(ROS))

from cvo_edge_ros.estimation import (  # noqa: E402 - ROS's folder is no package of ours
    PARAMETERS,
    answers,
    camera_of,
    frame_of,
    settings_of,
)
from cvo_edge_ros.filling import filled  # noqa: E402
from cvo_edge_ros.newest import Newest  # noqa: E402

NOW_NS = 1_700_000_000_500_000_000


def header(stamp_ns=NOW_NS, frame_id="camera"):
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return SimpleNamespace(
        stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame_id
    )


def image_message(pixels, encoding, *, big=False, padding=0, stamp_ns=NOW_NS):
    """A sensor_msgs/Image as rclpy has it: data are an array of bytes, rows are padded."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return SimpleNamespace(
        header=header(stamp_ns),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=big,
        step=data.shape[1],
        data=array("B", data.tobytes()),
    )


def scene():
    y, x = np.mgrid[:24, :32].astype(np.uint8)
    return np.stack([4 * x, 8 * y, 4 * x + 2 * y], axis=2)


BGR = scene()
GREY = np.repeat(cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)[..., np.newaxis], 3, axis=2)


def bayer(pattern):
    """A mosaic of the scene: the colour of each pixel as the pattern says."""
    channels = {"r": 2, "g": 1, "b": 0}
    mosaic = np.empty(BGR.shape[:2], np.uint8)
    for place, name in enumerate(pattern):
        rows, columns = slice(place // 2, None, 2), slice(place % 2, None, 2)
        mosaic[rows, columns] = BGR[rows, columns, channels[name]]
    return mosaic


WIDE = GREY[..., 0].astype(np.uint16) * 256 + 9
TAKEN = {
    "bgr8": (BGR, BGR, 0),
    "rgb8": (BGR[..., ::-1], BGR, 0),
    "bgra8": (np.dstack([BGR, BGR[..., :1]]), BGR, 0),
    "mono8": (GREY[..., 0], GREY, 0),
    "mono16": (WIDE, GREY, 0),
    "uyvy": (cv2.cvtColor(BGR, cv2.COLOR_BGR2YUV_UYVY), BGR, 12),
    "yuyv": (cv2.cvtColor(BGR, cv2.COLOR_BGR2YUV_YUY2), BGR, 12),
    **{f"bayer_{p}8": (bayer(p), BGR, 12) for p in ("rggb", "bggr", "gbrg", "grbg")},
}


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", TAKEN)
def test_every_encoding_gives_the_image(encoding, padding):
    pixels, wanted, tolerance = TAKEN[encoding]
    found = frame_of(image_message(pixels, encoding, padding=padding), 0, NOW_NS).image
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(found[inner].astype(int) - wanted[inner]).max() <= tolerance


def test_big_endian_numbers_are_read():
    message = image_message(WIDE.astype(">u2"), "mono16", big=True)
    assert np.array_equal(frame_of(message, 0, NOW_NS).image, GREY)


def test_half_a_picture_comes_from_a_jpeg_alone():
    content = cv2.imencode(".jpg", BGR)[1].tobytes()
    message = SimpleNamespace(header=header(), format="jpeg", data=array("B", content))
    image = frame_of(message, 0, NOW_NS, decode="half").image
    assert np.array_equal(image, decode_image(content, decode="half"))
    with pytest.raises(UsageError, match="uncompressed image"):
        frame_of(image_message(BGR, "bgr8"), 0, NOW_NS, decode="half")


def test_compressed_images_are_decoded():
    data = array("B", cv2.imencode(".png", BGR)[1].tobytes())
    message = SimpleNamespace(header=header(), format="bgr8; png compressed bgr8", data=data)
    assert np.array_equal(frame_of(message, 0, NOW_NS).image, BGR)


@pytest.mark.parametrize(
    "message",
    [
        image_message(WIDE, "16UC1"),
        image_message(WIDE.astype(np.float32), "32FC1"),
        image_message(BGR[..., 0], "nonsense"),
        SimpleNamespace(**{**vars(image_message(BGR, "bgr8")), "height": 25}),
        SimpleNamespace(**{**vars(image_message(BGR, "bgr8")), "step": 90}),
        SimpleNamespace(
            header=header(),
            format="16UC1; png compressed",
            data=array("B", cv2.imencode(".png", WIDE)[1].tobytes()),
        ),
        SimpleNamespace(header=header(), format="jpeg", data=array("B", b"\xff\xd8no image")),
    ],
    ids=["depth", "float", "unknown", "short", "narrow", "compressed depth", "torn"],
)
def test_what_is_no_picture_of_a_camera_is_none(message):
    assert frame_of(message, 0, NOW_NS).image is None


def test_a_frame_is_as_old_as_its_stamp_and_is_stamped_without():
    late = frame_of(image_message(BGR, "bgr8", stamp_ns=NOW_NS - 10**8), 3, NOW_NS)
    assert (late.stamp_ns, late.queued_ms, late.skipped) == (NOW_NS - 10**8, 100.0, 3)
    ahead = frame_of(image_message(BGR, "bgr8", stamp_ns=NOW_NS + 10**8), 0, NOW_NS)
    assert (ahead.stamp_ns, ahead.queued_ms) == (NOW_NS + 10**8, 0.0)
    assert frame_of(image_message(BGR, "bgr8", stamp_ns=0), 0, NOW_NS).stamp_ns == NOW_NS


def camera_info(model="plumb_bob", d=(0.1, -0.02, 1e-3, 2e-3, 0.0), **changes):
    return SimpleNamespace(
        **{
            "width": 640,
            "height": 480,
            "distortion_model": model,
            "d": array("d", d),
            "k": np.array([500.0, 0, 320, 0, 501, 240, 0, 0, 1]),
            "p": np.array([450.0, 0, 300, 0, 0, 451, 230, 0, 0, 0, 1, 0]),
            "binning_x": 0,
            "binning_y": 0,
            "roi": SimpleNamespace(width=0, height=0),
            **changes,
        }
    )


@pytest.mark.parametrize(
    ("info", "topic", "wanted"),
    [
        (camera_info(), "/cam/image_raw", (500.0, 501.0, 320.0, 240.0, "radial_tangential", 5)),
        (camera_info(), "/cam/image_rect", (450.0, 451.0, 300.0, 230.0, "none", 0)),
        (camera_info(d=()), "image_raw", (500.0, 501.0, 320.0, 240.0, "none", 0)),
        (
            camera_info("rational_polynomial", [0.1] * 8),
            "/cam/image_raw/compressed",
            (500.0, 501.0, 320.0, 240.0, "radial_tangential", 8),
        ),
        (
            camera_info("equidistant", [0.1] * 4),
            "image_raw",
            (500.0, 501.0, 320.0, 240.0, "equidistant", 4),
        ),
    ],
)
def test_the_camera_is_that_of_the_message(info, topic, wanted):
    camera = camera_of(info, topic)
    assert (camera.width, camera.height) == (640, 480)
    found = (camera.fx, camera.fy, camera.cx, camera.cy)
    assert (*found, camera.distortion, len(camera.coefficients)) == wanted


@pytest.mark.parametrize(
    ("info", "said"),
    [
        (camera_info(k=np.zeros(9)), "expected a calibrated camera, found zeros"),
        (camera_info("omni", [0.1] * 5), "expected the lens model plumb_bob"),
        (camera_info(binning_x=2), "expected whole images without binning"),
        (camera_info(roi=SimpleNamespace(width=320, height=240)), "expected whole images"),
        (camera_info(k=np.array([500.0, 0, 9e5, 0, 501, 240, 0, 0, 1])), "expected cx from"),
        (camera_info(k=np.array([-5.0, 0, 320, 0, 501, 240, 0, 0, 1])), "camera"),
    ],
)
def test_a_camera_that_cannot_be_used_is_refused(info, said):
    with pytest.raises(UsageError, match=said):
        camera_of(info, "image_raw")


def test_only_the_newest_message_is_kept():
    newest, taken = Newest(), []
    newest.put("a")
    newest.put("b")
    reader = Thread(target=lambda: taken.extend(newest))
    newest.put("c")
    newest.close()
    reader.start()
    reader.join(10)
    assert taken == [("c", 2)]


def settings(bundle_dir, **changes):
    return settings_of({**PARAMETERS, "bundle": str(bundle_dir), **changes})


def test_the_node_says_what_the_table_says(bundle_dir, clip_dir):
    """Images of a clip, one black, one of depth: the messages are those of run's records."""
    with Odometer.load(bundle_dir) as odometer:
        images = [frame.image for frame in open_source(str(clip_dir))][:2]
        images.append(np.zeros_like(images[0]))
        stamps = [NOW_NS + 10**8 * number for number in range(4)]
        sent = [
            image_message(image, "bgr8", stamp_ns=stamp)
            for image, stamp in zip(images, stamps, strict=False)
        ]
        sent.append(image_message(WIDE, "16UC1", stamp_ns=stamps[3]))
        chart, calibration = odometer.chart, odometer.calibration
        shared = header_of(calibration, chart, 0.9, "marginal")
        placement = Placement.of(shared)
        expected = [
            list(ros_messages(odometer.step(image, stamp, "camera"), placement, shared))
            for image, stamp in zip([*images, None], stamps, strict=True)
        ]
    given = [
        answer
        for message in sent
        for answer in answers(settings(bundle_dir), None, [(message, 0)], lambda: stamps[0])
    ]
    for answer, wanted in zip(given, expected, strict=True):
        plain = [each for each in wanted if each.type != "tf2_msgs/msg/TFMessage"]
        assert [each.topic for each in answer.messages] == [each.topic for each in plain]
        for got, one in zip(answer.messages, plain, strict=True):
            if got.topic != "/diagnostics":
                assert got == one
                continue
            got, one = got.content["status"][0], one.content["status"][0]
            assert (got["level"], got["message"]) == (one["level"], one["message"])
    assert [answer.news for answer in given] == ["ok", "ok", *[e.news for e in given[2:]]]
    assert given[3].news == "invalid image_unreadable"


@pytest.mark.parametrize("stamp_ns", [-5, -(2**31) * 10**9])
def test_an_image_with_a_stamp_below_zero_does_not_end_the_node(bundle_dir, stamp_ns):
    sent = [(image_message(BGR, "bgr8", stamp_ns=stamp_ns), 0)]
    (answer,) = answers(settings(bundle_dir), None, sent, lambda: NOW_NS)
    assert "stamp_implausible" in answer.news
    stamp = answer.messages[0].content["header"]["stamp"]
    assert 10**9 * stamp["sec"] + stamp["nanosec"] == stamp_ns
    assert not [each for each in answer.messages if each.topic.endswith("pose")]


def test_dropped_frames_leave_a_gap_and_the_transform_is_given_on_request(bundle_dir, clip_dir):
    image = next(iter(open_source(str(clip_dir)))).image
    asked = settings(bundle_dir, publish_tf=True, map="0,0,1,0,0,0,1")
    (answer,) = answers(asked, None, [(image_message(image, "bgr8"), 4)], lambda: NOW_NS)
    messages = {each.topic: each.content for each in answer.messages}
    values = messages["/diagnostics"]["status"][0]["values"]
    assert {"key": "seq", "value": "4"} in values
    assert messages["/tf"]["transforms"][0]["header"]["frame_id"] == "map"


def test_every_message_fits_its_definition(bundle_dir, clip_dir):
    """Classes as rclpy has them, made from rosbags' definitions."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def described(field):
        node, detail = field
        if node.name == "NAME":
            return detail.replace("/msg/", "/")
        if node.name == "BASE":
            return {"float64": "double", "byte": "octet"}.get(detail[0], detail[0])
        return f"sequence<{described(detail[0])}>"

    def load(name):
        full = name if "/msg/" in name else name.replace("/", "/msg/")
        kinds = {key: described(field) for key, field in store.fielddefs[full][1]}
        body = {"get_fields_and_field_types": lambda self: kinds, "__slots__": tuple(kinds)}
        return type(full, (), body)

    image = next(iter(open_source(str(clip_dir)))).image
    asked = settings(bundle_dir, publish_tf=True)
    (answer,) = answers(asked, None, [(image_message(image, "bgr8"), 0)], lambda: NOW_NS)
    for message in answer.messages:
        # A field that the type does not have raises.
        filled(message.type, message.content, load)
    got = filled(answer.messages[0].type, answer.messages[0].content, load)
    assert got.status[0].level == b"\x00"
    assert got.header.stamp.nanosec == 500_000_000


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"bundle": ""}, "bundle: expected the folder"),
        ({"scope": "all"}, "parameters: Invalid enum value 'all'"),
        ({"confidence": "high"}, "parameters: Expected `float`"),
        ({"speed": 1}, "unknown field `speed`"),
    ],
)
def test_parameters_are_checked(bundle_dir, changes, said):
    with pytest.raises(UsageError, match=said):
        settings(bundle_dir, **changes)


def test_topics_follow_from_the_images(bundle_dir):
    beside = settings(bundle_dir, image_topic="/front/image_rect/compressed")
    assert (beside.compressed, beside.info_topic) == (True, "/front/camera_info")
    assert settings(bundle_dir).info_topic == "camera_info"
    assert settings(bundle_dir, camera_info_topic="none").info_topic is None


def test_the_files_of_the_package_agree():
    yaml = pytest.importorskip("yaml")
    given = yaml.safe_load((ROS / "config" / "params.yaml").read_text("utf-8"))
    assert given["/**"]["ros__parameters"] == PARAMETERS
    package = ET.parse(ROS / "package.xml").getroot()
    needed = {each.text for each in package.findall("exec_depend")}
    sources = [*ROS.glob("cvo_edge_ros/*.py"), *ROS.glob("launch/*.py")]
    texts = [path.read_text("utf-8") for path in sources]
    imported = {
        name.split(".")[0]
        for text in texts
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else
                     [each.name for each in node.names])
    }  # fmt: skip
    ours = {"cvo_edge", "cvo_edge_ros", "numpy", "msgspec"}
    assert imported - set(sys.stdlib_module_names) - ours <= needed
    version = (ROS.parent / "cvo_edge" / "vocabulary.py").read_text("utf-8")
    assert f'VERSION = "{package.findtext("version")}"' in version
    assert f'version="{package.findtext("version")}"' in (ROS / "setup.py").read_text("utf-8")
    assert (ROS / "resource" / package.findtext("name")).exists()
    yaml.safe_load((ROS / "rviz" / "cvo_edge.rviz").read_text("utf-8"))
    (launched,) = (
        ast.literal_eval(node.value)
        for node in ast.parse((ROS / "launch" / "odometry.launch.py").read_text("utf-8")).body
        if isinstance(node, ast.Assign)
    )
    assert set(launched) <= set(PARAMETERS)


# Its libraries use what Python will not have for ever.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_node_answers_over_ros(bundle_dir, clip_dir, monkeypatch):
    """With rclpy: two images after CameraInfo, one of them black, from another node."""
    rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import CameraInfo, Image

    from cvo_edge_ros.node import NEWEST_IMAGE, Odometry

    given = {"bundle": str(bundle_dir), "map": "0,0,1,0,0,0,1"}
    arguments = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    rclpy.init(args=["--ros-args", *arguments])
    try:
        node, talker, executor = Odometry(), rclpy.create_node("talker"), SingleThreadedExecutor()
        for each in (node, talker):
            executor.add_node(each)
        poses, statuses = [], []
        talker.create_subscription(PoseWithCovarianceStamped, "cvo/pose", poses.append, 10)
        talker.create_subscription(DiagnosticArray, "/diagnostics", statuses.append, 10)
        info = talker.create_publisher(CameraInfo, "camera_info", NEWEST_IMAGE)
        images = talker.create_publisher(Image, "image_raw", NEWEST_IMAGE)
        camera = Odometer.load(bundle_dir).calibration.camera
        k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        clip = [frame.image for frame in open_source(str(clip_dir))]
        for scale, level in ((1, b"\x00"), (0, b"\x02")):
            # Both ends have to find each other: what is sent before is lost.
            for picture in 6 * clip:
                if poses and statuses and statuses[-1].status[0].level == level:
                    break
                image = scale * picture
                message = Image(
                    height=image.shape[0],
                    width=image.shape[1],
                    encoding="bgr8",
                    step=image.strides[0],
                    data=array("B", image.tobytes()),
                )
                message.header.stamp = talker.get_clock().now().to_msg()
                info.publish(CameraInfo(width=camera.width, height=camera.height, k=k))
                images.publish(message)
                for _ in range(10):
                    executor.spin_once(timeout_sec=0.02)
        node.close()
        assert statuses[-1].status[0].message.startswith("image_black")
        assert poses[0].header.frame_id == "map"
        assert min(np.array(poses[0].pose.covariance).reshape(6, 6).diagonal()) > 0.0
    finally:
        rclpy.try_shutdown()
