"""ROS bags of every kind, written and read back with rosbags' own writers and readers."""

import re
import shutil
import sqlite3
import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.ground_truth import named_files, open_ground_truth
from cvo_edge.pose import Pose
from cvo_export.datasets import Intrinsics, Lens, open_dataset

from .true_poses import same_as_training

rosbags = pytest.importorskip("rosbags.highlevel")
from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
TF_MESSAGE = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/TFMessage")
if "tf2_msgs/msg/TFMessage" not in STORES[1].types:
    STORES[1].register(TF_MESSAGE)
KINDS = ["ros1", "ros1-lz4", "sqlite3", "sqlite3-zstd", "sqlite3-undefined", "db3", "mcap-folder"]
KINDS += ["mcap-zstd", "mcap"]
START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
WIDTH, HEIGHT = 24, 16


class Maker:
    """Makes messages for one version of ROS."""

    def __init__(self, version):
        self.version, self.types = version, STORES[version].types
        self.count = 0

    def __getattr__(self, name):
        package, message = name.split("__")
        return self.types[f"{package}/msg/{message}"]

    def header(self, stamp_ns, frame):
        time = self.builtin_interfaces__Time(*divmod(stamp_ns, 10**9))
        self.count += 1
        extra = {"seq": self.count} if self.version == 1 else {}
        return self.std_msgs__Header(stamp=time, frame_id=frame, **extra)

    def image(self, stamp_ns, data, encoding, frame="cam", step=0, big=0):
        height, width = data.shape[:2]
        return self.sensor_msgs__Image(
            header=self.header(stamp_ns, frame),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=big,
            step=step or data.nbytes // height,
            data=np.frombuffer(data.tobytes(), np.uint8),
        )

    def compressed(self, stamp_ns, image, suffix=".png", frame="cam", form="png"):
        data = np.frombuffer(cv2.imencode(suffix, image)[1].tobytes(), np.uint8)
        header = self.header(stamp_ns, frame)
        return self.sensor_msgs__CompressedImage(header=header, format=form, data=data)

    def pose(self, T):
        p, q = T[:3, 3].tolist(), Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        point = self.geometry_msgs__Point(*p)
        return self.geometry_msgs__Pose(point, self.geometry_msgs__Quaternion(*q))

    def posed(self, kind, stamp_ns, T, frame="map", child="base"):
        header, pose, none = self.header(stamp_ns, frame), self.pose(T), np.zeros(36)
        covered = self.geometry_msgs__PoseWithCovariance(pose=pose, covariance=none)
        if kind == "PoseStamped":
            return self.geometry_msgs__PoseStamped(header, pose)
        if kind == "PoseWithCovarianceStamped":
            return self.geometry_msgs__PoseWithCovarianceStamped(header, covered)
        if kind == "TransformStamped":
            return self.transform(stamp_ns, frame, child, T)
        zero = self.geometry_msgs__Vector3(0.0, 0.0, 0.0)
        twist = self.geometry_msgs__TwistWithCovariance(
            twist=self.geometry_msgs__Twist(zero, zero), covariance=none
        )
        return self.nav_msgs__Odometry(header, child, covered, twist)

    def transform(self, stamp_ns, frame, child, T):
        pose = self.pose(T)
        t = self.geometry_msgs__Vector3(*T[:3, 3].tolist())
        moved = self.geometry_msgs__Transform(t, pose.orientation)
        return self.geometry_msgs__TransformStamped(self.header(stamp_ns, frame), child, moved)

    def tf(self, *transforms):
        return self.tf2_msgs__TFMessage(list(transforms))

    def info(self, model="plumb_bob", d=(0.1, -0.2, 0.001, 0.002, 0.0), frame="cam", width=WIDTH):
        k = np.array([20.0, 0, 11.5, 0, 21.0, 7.5, 0, 0, 1])
        p = np.array([19.0, 0, 11.0, 0, 0, 19.5, 7.0, 0, 0, 0, 1, 0])
        names = [n.upper() if self.version == 1 else n for n in "dkrp"]
        matrices = dict(zip(names, (np.array(d), k, np.eye(3).ravel(), p), strict=True))
        roi = self.sensor_msgs__RegionOfInterest(0, 0, 0, 0, False)
        return self.sensor_msgs__CameraInfo(
            header=self.header(START_NS, frame),
            height=HEIGHT,
            width=width,
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **matrices,
        )


def write(path, kind, messages):
    """Write (topic, time ns, message) in order of time; return the path to read."""
    version = 1 if kind.startswith("ros1") else 2
    store = STORES[version]
    if version == 1:
        path = path.with_suffix(".bag")
        writer = rosbag1.Writer(path)
        if kind == "ros1-lz4":
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    else:
        plugins = rosbag2.StoragePlugin
        plugin = plugins.MCAP if kind.startswith("mcap") else plugins.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if kind.endswith("zstd"):
            mode = rosbag2.CompressionMode.MESSAGE
            writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    serialise = store.serialize_ros1 if version == 1 else store.serialize_cdr
    with writer:
        topics = {}
        for topic, time, message in messages:
            kind_of = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind_of, typestore=store)
            writer.write(topics[topic], time, serialise(message, kind_of))
    if kind == "sqlite3-undefined":
        with sqlite3.connect(path / f"{path.name}.db3") as database:
            database.execute("UPDATE schema SET schema_version = 3")
            database.execute("DELETE FROM message_definitions")
        database.close()
    if kind in ("db3", "mcap"):
        file = (path / f"{path.name}.{kind}").rename(path.with_suffix(f".{kind}"))
        shutil.rmtree(path)
        return file
    return path


def place(k):
    """Pose of the camera at step k: it walks and turns."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.02 * k, 0.3 + 0.05 * k, -0.01 * k]).as_matrix()
    T[:3, 3] = 0.1 * k, 0.02 * k * k, 1.0
    return T


def picture(k):
    return np.random.default_rng(k).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def recording(make, count=6, pose="PoseStamped", images="/cam/image_raw", encoding="bgr8"):
    """Images each 100 ms, and a pose 5 ms later; recorded 3 ms after their stamps."""
    for k in range(count):
        stamp = START_NS + 100 * k * MS
        yield images, stamp + 3 * MS, make.image(stamp, picture(k), encoding)
        after = stamp + 5 * MS
        yield "/pose", after + 3 * MS, make.posed(pose, after, place(k), child="cam")


def maker(kind):
    return Maker(1 if kind.startswith("ros1") else 2)


def read_independently(path, topic):
    with rosbags.AnyReader([path], default_typestore=STORES[2]) as reader:
        wanted = [each for each in reader.connections if each.topic == topic]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted)]
        return [(m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, m) for m in messages]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_agrees_with_reading_it_by_rosbags(tmp_path, kind):
    make = maker(kind)
    messages = [("/cam/camera_info", START_NS, make.info()), *recording(make)]
    path = write(tmp_path / "walk", kind, messages)
    found = open_dataset(f"rosbag:{path}")
    images, poses = (read_independently(path, t) for t in ("/cam/image_raw", "/pose"))
    assert found.sequence_names == ("walk",)
    assert found.chosen == "images /cam/image_raw; poses /pose"
    assert found.stamps_ns.tolist() == [stamp for stamp, _ in images]
    assert found.frame_names[1] == "walk/1700000000.100000000"
    for index, (_, message) in reversed(list(enumerate(images))):  # in any order
        np.testing.assert_array_equal(found.read_image(index).ravel(), message.data)
        assert found.image_size(index) == (HEIGHT, WIDTH)
    times = np.array([stamp - START_NS for stamp, _ in poses], float)
    turns = Rotation.from_quat(
        [[getattr(m.pose.orientation, axis) for axis in "xyzw"] for _, m in poses]
    )
    at = np.clip([stamp - START_NS for stamp, _ in images], times[0], None)
    expected = Slerp(times, turns)(at)
    error = expected.inv() * Rotation.from_quat(found.poses[:, 3:])
    assert error.magnitude().max() < 1e-9
    x = np.interp(at, times, [m.pose.position.x for _, m in poses])
    np.testing.assert_allclose(found.poses[:, 0], x, atol=1e-12)
    assert found.intrinsics == Intrinsics(20.0, 21.0, 11.5, 7.5)
    assert found.lens == Lens("radial_tangential", (0.1, -0.2, 0.001, 0.002, 0.0))


@pytest.mark.parametrize(
    "pose", ["PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry"]
)
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_poses_of_every_type(tmp_path, kind, pose):
    path = write(tmp_path / "a", kind, recording(maker(kind), 2, pose))
    found = open_dataset(f"rosbag:{path}")
    T = Pose.from_array(found.poses[0]).to_matrix()
    np.testing.assert_allclose(T, place(0), atol=1e-12)


def bayer(image, pattern):
    """Keep of each pixel of a BGR image what a sensor of this pattern sees."""
    mosaic = np.zeros(image.shape[:2], np.uint8)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = image[row::2, column::2, "bgr".index(colour)]
    return mosaic


FLAT = np.full((HEIGHT, WIDTH, 3), (40, 90, 200), np.uint8)
GREY = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
WIDE = np.full((HEIGHT, WIDTH), 90 * 256 + 17, np.uint16)
ENCODINGS = [
    ("rgb8", FLAT[..., ::-1], FLAT, 0),
    ("bgra8", np.dstack([FLAT, GREY[..., 0]]), FLAT, 0),
    ("rgba8", np.dstack([FLAT[..., ::-1], GREY[..., 0]]), FLAT, 0),
    ("mono8", GREY[..., 0], GREY, 0),
    ("mono16", WIDE, GREY, 0),
    ("mono16", WIDE.byteswap(), GREY, 1),
    ("rgb16", FLAT[..., ::-1].astype(np.uint16) * 256 + 255, FLAT, 0),
    *((f"bayer_{p}8", bayer(FLAT, p), FLAT, 0) for p in ("rggb", "bggr", "gbrg", "grbg")),
    ("bayer_rggb16", bayer(FLAT, "rggb").astype(np.uint16) * 256, FLAT, 0),
]


def test_encodings_give_the_same_picture(tmp_path):
    make = maker("mcap")
    messages = []
    for k, (encoding, data, _, big) in enumerate(ENCODINGS):
        stamp = START_NS + 100 * k * MS
        messages.append(("/image", stamp, make.image(stamp, data, encoding, big=big)))
        messages.append(("/pose", stamp, make.posed("PoseStamped", stamp, place(k))))
    # Rows that are padded, and two frames that are received at one time.
    last, padded = messages[-2][1], np.pad(FLAT, ((0, 0), (0, 2), (0, 0)))
    image = make.image(last + 10 * MS, padded, "bgr8")
    image.width = WIDTH
    messages.append(("/image", last, image))
    found = open_dataset(f"rosbag:{write(tmp_path / 'a', 'mcap', messages)}")
    assert len(found) == len(ENCODINGS) + 1
    wanted = [expected for _, _, expected, _ in ENCODINGS] + [FLAT]
    for index, expected in enumerate(wanted):
        # Borders of a mosaic are guessed.
        inner = found.read_image(index)[2:-2, 2:-2].astype(int)
        assert np.abs(inner - expected[2:-2, 2:-2]).max() <= 1, found.frame_names[index]


def test_the_image_is_preferred_to_its_compressed_copy_and_depth_is_none(tmp_path):
    make = maker("sqlite3")
    messages = []
    for k, row in enumerate(recording(make, 2)):
        messages.append(row)
        stamp = row[1]
        if k % 2 == 0:
            copy = make.compressed(stamp - 3 * MS, picture(7), ".jpg", form="jpeg")
            messages.append(("/cam/image_raw/compressed", stamp, copy))
            messages.append(("/depth/image", stamp, make.image(stamp, WIDE, "16UC1")))
    path = write(tmp_path / "a", "sqlite3", messages)
    np.testing.assert_array_equal(open_dataset(f"rosbag:{path}").read_image(0), picture(0))
    chosen = open_dataset(f"rosbag:{path},image=/cam/image_raw/compressed")
    assert np.abs(chosen.read_image(0).astype(int) - picture(7)).mean() < 60
    with pytest.raises(SourceError, match=re.escape("8 or 16 bits in /depth/image, found 16UC1")):
        open_dataset(f"rosbag:{path},image=/depth/image")


MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("zyx", [-90, 0, -90], degrees=True).as_matrix()
MOUNT[:3, 3] = 0.2, -0.1, 0.4


def robot(make, body="base", static_topic="/tf_static"):
    """A robot whose /tf says map -> odom -> base -> mast -> cam; images between the transforms."""
    drift, step = np.eye(4), np.eye(4)
    drift[:3, 3] = 5.0, 6.0, 0.0
    step[:3, 3] = 0.0, 0.0, 1.5
    mast = make.transform(START_NS, body, "mast", step)
    camera = make.transform(START_NS, "mast", "cam", np.linalg.inv(step) @ MOUNT)
    yield static_topic, START_NS, make.tf(mast, camera)
    for k in range(8):
        stamp = START_NS + 30 * k * MS
        chain = make.transform(stamp, "map", "odom", drift)
        yield "/tf", stamp, make.tf(chain, make.transform(stamp, "odom", body, place(k)))
        yield "/odom", stamp, make.posed("Odometry", stamp, place(k), "odom", body)
        yield "/mocap", stamp, make.posed("PoseStamped", stamp, place(k), "lab")
        yield "/image", stamp, make.image(stamp + 15 * MS, picture(k), "bgr8")


def between(k, T_camera, drift=(0.0, 0.0, 0.0)):
    """The camera half way between steps k and k + 1."""
    turns = Rotation.from_matrix([place(k)[:3, :3], place(k + 1)[:3, :3]])
    T = np.eye(4)
    T[:3, :3] = Slerp([0, 1], turns)(0.5).as_matrix()
    T[:3, 3] = (place(k)[:3, 3] + place(k + 1)[:3, 3]) / 2 + drift
    return T @ T_camera


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_transforms_lead_to_the_camera(tmp_path, kind):
    path = write(tmp_path / "robot", kind, robot(maker(kind)))
    matrix = tmp_path / "T_body_camera.txt"
    np.savetxt(matrix, MOUNT)
    drift = (5.0, 6.0, 0.0)
    for options, T_camera, moved in (
        ("pose=/tf", MOUNT, drift),  # the topmost frame, the frame of the images
        ("world=map", MOUNT, drift),
        ("world=odom", MOUNT, (0, 0, 0)),
        ("world=odom,frame=base", np.eye(4), (0, 0, 0)),
        ("pose=/odom", MOUNT, (0, 0, 0)),  # child_frame_id
        ("pose=/odom,extrinsics=none", np.eye(4), (0, 0, 0)),
        (f"pose=/odom,extrinsics={matrix}", MOUNT, (0, 0, 0)),
        ("pose=/mocap", np.eye(4), (0, 0, 0)),  # names no frame
        ("pose=/mocap,body=base", MOUNT, (0, 0, 0)),
        (f"pose=/mocap,extrinsics={matrix}", MOUNT, (0, 0, 0)),
    ):
        found = open_dataset(f"rosbag:{path},{options}")
        T = Pose.from_array(found.poses[3]).to_matrix()
        np.testing.assert_allclose(T, between(3, T_camera, moved), atol=1e-12, err_msg=options)


def test_cameras(tmp_path):
    def camera(name, topic="/cam/image_raw", infos=(), options=""):
        make = maker("mcap")
        rows = [(at, START_NS, make.info(**fields)) for at, fields in infos]
        path = write(tmp_path / name, "mcap", [*rows, *recording(make, 2, images=topic)])
        found = open_dataset(f"rosbag:{path}{options}")
        return found.intrinsics, found.lens

    own = Intrinsics(20.0, 21.0, 11.5, 7.5)
    fisheye = {"model": "equidistant", "d": (0.1, 0.2, 0.3, 0.4)}
    assert camera("a") == (None, Lens())
    assert camera("b", infos=[("/x/info", fisheye)]) == (own, Lens("equidistant", (*fisheye["d"],)))
    assert camera("c", infos=[("/cam/camera_info", {"d": np.zeros(5)})]) == (own, Lens())
    long = {"model": "rational_polynomial", "d": np.arange(1, 9) / 100}
    lens = Lens("radial_tangential", tuple(np.arange(1, 9) / 100))
    # The one beside the images, of several that fit.
    both = [("/other/info", fisheye), ("/cam/camera_info", long)]
    assert camera("d", infos=both) == (own, lens)
    # Those of another frame or size are of another camera.
    assert camera("e", infos=[("/i", {"frame": "depth"}), ("/j", {"width": 99})])[0] is None
    assert camera("f", infos=both, options=",camera=none")[0] is None
    assert camera("g", infos=[("/x/info", {"model": "omni"})])[0] is None
    rectified = camera("h", "/cam/image_rect", [("/cam/camera_info", {})])
    assert rectified == (Intrinsics(19.0, 19.5, 11.0, 7.0), Lens())
    with pytest.raises(SourceError, match=r"one CameraInfo of the images, found /i, /j; choose"):
        camera("i", infos=[("/i", {}), ("/j", {})])
    with pytest.raises(SourceError, match=r"camera of 24x16 images, found that of 99x16"):
        camera("j", infos=[("/i", {"width": 99})], options=",camera=/i")


def test_several_bags_are_sequences_in_natural_order(tmp_path):
    for number, kind in ((10, "mcap"), (2, "sqlite3"), (1, "db3")):
        write(tmp_path / f"run{number}", kind, recording(maker(kind), 2))
    (tmp_path / "notes.txt").touch()
    (tmp_path / "empty").mkdir()
    found = open_dataset(f"rosbag:{tmp_path}")
    assert found.sequence_names == ("run1", "run2", "run10")
    assert found.sequence.tolist() == [0, 0, 1, 1, 2, 2]
    np.testing.assert_array_equal(found.read_image(5), picture(1))


def test_frames_that_cannot_be_used_are_counted(tmp_path):
    make = maker("mcap")
    rows = list(recording(make, 8))
    rows[2][2].data = rows[2][2].data[:-5]  # an image that ends early
    rows[5][2].pose.orientation.w = float("nan")
    rows[7][2].header.stamp.nanosec += 50 * MS  # far from every image
    rows[10][2].header.stamp = rows[8][2].header.stamp
    rows[12][2].header.stamp = make.builtin_interfaces__Time(0, 0)  # received 3 ms later
    found = open_dataset(f"rosbag:{write(tmp_path / 'a', 'mcap', rows)}")
    assert found.skipped == {
        "unreadable image": 1,
        "invalid pose": 1,
        "no pose within 0.02 s": 1,
        "stamp twice": 1,
    }
    assert found.stamps_ns.tolist() == [
        START_NS,
        START_NS + 400 * MS,
        START_NS + 603 * MS,
        START_NS + 700 * MS,
    ]


def refused(text, *parts):
    with pytest.raises(SourceError) as found:
        open_dataset(f"rosbag:{text}")
    message = str(found.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_what_is_missing_or_ambiguous_is_refused_with_the_candidates(tmp_path):
    make = maker("mcap")
    path = write(tmp_path / "robot", "mcap", robot(make))
    refused(
        f"{path},image=/no", "expected a topic /no, found none; topics of images: /image (bgr8)"
    )
    refused(path, "expected one topic of poses, found /mocap, /odom, /tf; choose one, e.g. pose=/m")
    refused(f"{path},pose=/x", "expected poses in /x, found none; topics with poses: /mocap, /odom")
    refused(f"{path},world=moon", "expected transforms from moon to cam, found none; frames in /tf")
    refused(f"{path},world=base", "expected a camera that moves, found transforms from base to cam")
    refused(f"{path},pose=/odom,extrinsics=no.txt", "no.txt: expected a file with a 4x4 matrix")
    with pytest.raises(UsageError, match=r"rosbag: expected PATH and any of image=.*found 'imag"):
        open_dataset(f"rosbag:{path},imagee=/image")
    two = [*recording(make, 2), *recording(make, 2, images="/right", pose="Odometry")]
    two.append(("/body", START_NS, make.posed("Odometry", START_NS, place(0))))
    path = write(tmp_path / "two", "mcap", two[:4] + two[4:8:2] + two[8:])
    refused(path, "expected one topic of images, found /cam/image_raw, /right; choose one, e.g. im")
    body = f"{path},image=/right,pose=/body"
    refused(
        body, "expected transforms from base, which /body tracks, to the camera cam, found none"
    )
    only = write(tmp_path / "only", "mcap", list(recording(make, 2))[::2])
    refused(only, "expected poses (PoseStamped, PoseWithCovarianceStamped, TransformStamped, Odom")
    late = list(recording(make, 2))
    for _, _, message in late[1::2]:
        message.header.stamp.sec += 3600
    refused(
        write(tmp_path / "late", "mcap", late),
        "expected frames with a pose, found none; images at 1700000000.000 .. 1700000000.100 s, "
        "poses at 1700003600.005 .. 1700003600.105 s; skipped 2: no pose within 0.02 s 2",
    )
    worlds = [list(recording(make, 2)), list(recording(make, 2))]
    (tmp_path / "worlds").mkdir()
    for name, rows in zip("ab", worlds, strict=True):
        for _, _, message in rows[1::2]:
            message.header.frame_id = f"map_{name}"
        write(tmp_path / "worlds" / name, "mcap", rows)
    refused(tmp_path / "worlds", "expected poses in one world frame, found map_a in a, map_b in b")


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_a_damaged_bag_is_one_line(tmp_path, kind):
    path = write(tmp_path / "a", kind, recording(maker(kind), 40))
    whole = path.read_bytes()
    for count in (0, 3, len(whole) // 3, len(whole) - 9):
        path.write_bytes(whole[:count])
        if kind != "db3" or count < len(whole) - 9:  # a database keeps what is missing elsewhere
            refused(path, f"{path}: expected a whole ROS bag, found a damaged, incomplete or other")
    torn = bytearray(whole)
    torn[len(whole) // 4 : len(whole) // 2] = bytes(len(whole) // 2 - len(whole) // 4)
    path.write_bytes(torn)
    if kind != "db3":
        refused(path, "expected a whole ROS bag")
    refused(tmp_path / "none", "or a folder of bags, found none")
    (tmp_path / "text.txt").write_text("no bag")
    refused(tmp_path / "text.txt", "or a folder of bags, found another file")


def frames_of(folder, path, topic):
    """A file for each image of a bag, with the name of its stamp."""
    folder.mkdir()
    for stamp, _ in read_independently(path, topic):
        name = f"{stamp // 10**9}.{stamp % 10**9:09d}.png"
        cv2.imwrite(str(folder / name), GREY)
    return folder


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_ground_truth_is_the_poses_of_training(tmp_path, kind):
    path = write(tmp_path / "robot", kind, robot(maker(kind)))
    matrix = tmp_path / "T_body_camera.txt"
    np.savetxt(matrix, MOUNT)
    frames = [frames_of(tmp_path / "frames", path, "/image")]
    for options, said in (
        ("pose=/tf", "/tf, map to cam"),
        ("world=odom,frame=base", "/tf, odom to base"),
        ("pose=/odom,image=/image,camera=none", "/odom of base, transformed to cam"),
        ("pose=/odom,extrinsics=none", "/odom of base, taken as the camera's"),
        ("pose=/mocap,body=base", "/mocap of base, transformed to cam"),
        (f"pose=/mocap,extrinsics={matrix}", "/mocap, extrinsics T_body_camera.txt"),
    ):
        dataset = f"rosbag:{path},{options}"
        truth = same_as_training(dataset, frames, dataset)
        assert (truth.found.note, truth.found.by) == (said, "stamp")
    assert named_files(f"rosbag:{path},extrinsics={matrix}") == [path, matrix]
    assert named_files(f"{path},pose=/tf") == [path]
    with pytest.raises(SourceError, match=r"found /mocap, /odom, /tf; choose one, e.g. pose="):
        open_ground_truth(path, frames[0])
    with pytest.raises(UsageError, match=r"rosbag: expected PATH and any of image=.*found 'poze"):
        open_ground_truth(f"{path},poze=/tf", frames[0])


def test_a_bag_alone_or_in_its_folder_is_ground_truth(tmp_path):
    make = maker("sqlite3")
    rows = list(recording(make, 6))
    rows[5][2].pose.orientation.w = float("nan")
    (tmp_path / "bags").mkdir()
    path = write(tmp_path / "bags" / "walk", "sqlite3", rows)
    frames = [frames_of(tmp_path / "frames", path, "/cam/image_raw")]
    for place in (path, tmp_path / "bags", f"rosbag:{tmp_path / 'bags'}"):
        truth = same_as_training(f"rosbag:{path}", frames, place)
        assert str(truth.skipped) == (
            "skipped 1: invalid pose 1 (first in walk, pose at 1700000000.205000000)"
        )
        assert truth.spans(None, None).startswith("frames without a stamp, poses at 1700000000.005")
    write(tmp_path / "bags" / "other", "mcap", rows)
    with pytest.raises(SourceError, match=r"expected the bag .*, found other.mcap, walk; name one"):
        open_ground_truth(tmp_path / "bags", frames[0])
    # A bag of poses alone says nothing of the camera, unless it needs not.
    path = write(tmp_path / "alone", "mcap", rows[1::2])
    assert open_ground_truth(path).found.note == "/pose"
    odometry = make.posed("Odometry", START_NS, MOUNT)
    path = write(tmp_path / "odom", "mcap", [("/odom", START_NS, odometry)])
    with pytest.raises(SourceError, match=r"images: none; or name the camera's frame, e.g. f"):
        open_ground_truth(path)
    assert open_ground_truth(f"{path},frame=base").found.note == "/odom of base"


def test_without_rosbags_one_line_says_what_to_install(tmp_path, monkeypatch):
    path = write(tmp_path / "a", "mcap", recording(maker("mcap"), 1))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    for read in (open_ground_truth, lambda path: open_dataset(f"rosbag:{path}")):
        with pytest.raises(UsageError) as refusal:
            read(path)
        assert str(refusal.value) == (
            f"{path}: expected the library rosbags to read a bag, found it not installed; pip "
            'install "cvo-edge[rosbag]", or write frames and poses where it is: cvo-export render '
            f"rosbag:{path} FOLDER"
        )
