#!/usr/bin/env python3
"""Makes a recording of README.md from a git copy of its public repository.

    python tests/data/real/make_extract.py RECORDING GIT_DIR OUT.npz

RECORDING: one of README.md. Needs git, numpy and opencv, hololens and r200_ceiling also scipy.
"""

import io
import re
import subprocess
import sys
import zipfile

import cv2
import numpy as np

if len(sys.argv) != 4:
    raise SystemExit(__doc__)
_, recording, git_dir, out = sys.argv


def show(*paths, commit="HEAD"):
    """The contents of files, one after another."""
    batch = "".join(f"{commit}:{path}\n" for path in paths).encode()
    command = ["git", "-C", git_dir, "cat-file", "--batch"]
    data = subprocess.run(command, input=batch, capture_output=True, check=True).stdout
    while data:
        head, data = data.split(b"\n", 1)
        if head.endswith(b" missing"):
            raise SystemExit(
                f"{git_dir} is no copy of the repository of {recording}: {head.decode()}"
            )
        size = int(head.split()[2])
        yield data[:size]
        data = data[size + 1 :]


def images(*paths, commit="HEAD", flags=-1):
    return [
        cv2.imdecode(np.frombuffer(png, np.uint8), flags) for png in show(*paths, commit=commit)
    ]


def intrinsics(fx, fy, cx, cy):
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def save(depth, K, fps=1.0, frame_index=None, **truth):
    index = np.arange(len(depth)) if frame_index is None else frame_index
    np.savez_compressed(
        out, depth_m=np.stack(depth).astype(np.float32), K=K, fps=fps, frame_index=index, **truth
    )
    print(out, len(depth), "images")


def adi_tof():
    """N = 0 to 5 fingers, of the branch gesture-recognition-challenge: single images, 640 x 480,
    depth in OpenCV's rainbow of 256 colours, which is undone without any remainder. An Analog
    Devices Time-of-Flight board (AD-96TOF1 or AD-FXTOF1). Colour 255 is the end of the near range,
    0.8 m in the repository's library, so a step is 3.1 mm; K is of the boards' field of view, 90 x
    69.2 degrees. labels: what each shows.
    """
    rainbow = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_RAINBOW)[0]
    value = np.zeros(1 << 24, np.uint8)
    value[rainbow.astype(int) @ [65536, 256, 1]] = np.arange(256)
    folder = "bindings/python/examples/gesture_recognition"
    paths = [f"{folder}/{n}fingers.png" for n in range(6)]
    seen = images(*paths, commit="af128282", flags=cv2.IMREAD_COLOR)
    steps = [value[image.astype(int) @ [65536, 256, 1]] for image in seen]
    depth = [np.where(step < 254, step * (0.8 / 255), 0) for step in steps]
    labels = "fist pointing victory three four palm".split()
    save(depth, intrinsics(320.0, 347.9, 319.5, 239.5), labels=np.array(labels))


def camcube(folder, labels):
    """OpenCV matrices of float metres, 200 x 200, along the ray: single images. Camera not named;
    this is what a PMD CamCube 3.0 gives, of whose lens (12.8 mm, pixels of 45 micrometres) K is
    made. Distances become depths along the axis; edges between near and far (flying pixels) are
    kept. labels: what each image shows, seen by eye (none: no hand; three: thumb and two fingers).
    """
    labels = labels.split()
    v, u = np.mgrid[:200, :200]
    to_axis = 1 / np.sqrt(1 + ((u - 99.5) / 284.4) ** 2 + ((v - 99.5) / 284.4) ** 2)
    depth = []
    for text in show(*(f"{folder}/{n}.yml" for n in range(1, len(labels) + 1))):
        numbers = re.search(r"data: \[(.*?)\]", text.decode(), re.DOTALL)[1].replace(",", " ")
        metres = np.array(numbers.split(), np.float32).reshape(200, 200) * to_axis
        depth.append(np.where(metres < 3, metres, 0))
    save(depth, intrinsics(284.4, 284.4, 99.5, 99.5), labels=np.array(labels))


def cvar(sequence):
    """CVAR/P1 to P7: a Creative Senz3D (Time of Flight, 320 x 240) on the head; K is that of
    CVAR/README; 16 bit, millimetres, 32001 = no reading. Depth and truth of P1 and P3 are
    multiplied by 0.7: as they are, the hand is 0.27 m long, and its bones are exactly 1 / 0.7 of
    those of the other four sequences of the same person. Truth: 21 joints (u, v, millimetres) in
    the order base of the palm (some 45 mm beyond the wrist), then MCP, PIP, DIP, tip of index,
    middle, ring, little, thumb; written in toftrack's order, thumb first.
    """
    scale = 0.0007 if sequence in ("P1", "P3") else 0.001
    (text,) = show(f"CVAR/{sequence}/joint.txt")
    lines = [line.split() for line in text.decode().splitlines()[1:]]
    depth, joints = [], []
    seen = images(*(line[0].removeprefix("./") for line in lines))
    for (_, *numbers), image in zip(lines, seen, strict=True):
        image = image[:, :320]
        depth.append(np.where(image < 32000, image, 0).astype(np.float32) * np.float32(scale))
        u, v, z = np.array(numbers, float).reshape(21, 3).T
        joints.append(np.stack([(u - 160) / 224.502 * z, (v - 120) / 230.494 * z, z], -1) * scale)
    order = [0, *range(17, 21), *range(1, 17)]
    truth = np.stack(joints)[:, order].astype(np.float32)
    save(depth, intrinsics(224.502, 230.494, 160, 120), fps=30.0, joints_m=truth)


def fpha():
    """Subject 1 puts salt: an Intel RealSense SR300 on the shoulder or head, 16 bit, millimetres,
    640 x 480; K is that of the repository's README (depth sensor).
    """
    folder = "Video_files/Subject_1/put_salt/1/depth/"
    command = ["git", "-C", git_dir, "ls-tree", "--name-only", "HEAD", folder]
    names = sorted(subprocess.run(command, capture_output=True, check=True).stdout.decode().split())
    depth = np.stack(images(*names)).astype(np.float32) / 1000
    save(depth, intrinsics(475.066, 475.066, 315.945, 245.287), fps=30.0)


def hamer_depth():
    """16 bit, millimetres, 640 x 360. Camera not named; K, which is the repository's, and noise are
    those of a passive stereo camera (a ZED, which the author's other programs use).
    """
    depth = images(*(f"data/demo/depth/{n:05d}.png" for n in range(2)))
    (text,) = show("data/demo/cam_K.txt")
    K = np.array(text.decode().split(), float).reshape(3, 3)
    save(np.stack(depth).astype(np.float32) / 1000, K, fps=30.0)


def kinect1_room():
    """17 single images of a Kinect v1, 640 x 480. The program kept only the lower eight of the
    camera's eleven bits; the room lies in the range whose upper bits are 768 (1.08 to 5 m), and
    what is beyond it (a sofa, the same in most of the images) is taken out. Metres are 0.1236
    tan(raw / 2842.5 + 1.1863); K is the usual one of this camera.
    """
    archive = zipfile.ZipFile(io.BytesIO(*show("depth_train.zip")))
    names = sorted(n for n in archive.namelist() if n.endswith(".png"))
    raw = np.stack([cv2.imdecode(np.frombuffer(archive.read(n), np.uint8), 0) for n in names])
    beyond = (raw < 100).mean(0) > 0.4
    depth = 0.1236 * np.tan((768.0 + raw) / 2842.5 + 1.1863)
    depth = np.where((raw < 240) & ~beyond, depth, 0)
    index = np.array([int(n[-9:-4]) for n in names])
    save(depth, intrinsics(594.2, 591.0, 339.3, 242.7), frame_index=index)


def r200_ceiling():
    """Two single images, 640 x 480, depth (16 bit, millimetres) in the colour camera's view. An
    Intel RealSense R200 (the repository brings its drivers); K is the usual one of its colour
    stream. joints_uv: the repository's 21 joints in pixels, in toftrack's order.
    """
    import scipy.io

    names = (f"resources/{name}.mat" for name in ("calibration_test", "calibration_apply_test"))
    contents = [scipy.io.loadmat(io.BytesIO(data)) for data in show(*names)]
    depth = np.stack([one["depth"][..., 0].astype(np.float32) / 1000 for one in contents])
    depth[depth > 10] = 0
    joints = np.stack([one["labels"][:, :2] * (640, 480) for one in contents]).astype(np.float32)
    labels = np.array(["palm", "pinch"])
    save(depth, intrinsics(615.0, 615.0, 319.5, 239.5), joints_uv=joints, labels=labels)


def bighand():
    """A single image of the BigHand2.2M set: an Intel RealSense SR300, 16 bit, millimetres, 640 x
    480; K is the repository's (data/hands17/holder.py).
    """
    depth = images("code_local/test/image_D00000030.png")[0] / 1000
    save([depth], intrinsics(475.066, 475.066, 315.945, 245.287))


def hololens():
    """A single image of the head: the near Time-of-Flight camera of a Microsoft HoloLens, 448 x
    450, whole millimetres along the ray, 4095 = no reading. The repository has the camera's table
    of the ray of each pixel, column by column (x to the left); a pinhole image of the resolution
    in the table's middle is made of it.
    """
    from scipy.interpolate import griddata

    file, table = show("sampleImage.pgm", "short_throw_depth_camera_space_projection.bin")
    image = cv2.imdecode(np.frombuffer(file, np.uint8), -1)
    x, y = np.frombuffer(table, np.float32).reshape(448, 450, 2).T.astype(float) * [[[-1]], [[1]]]
    known = np.isfinite(x)
    metres = np.where(image < 1000, image / 1000 / np.sqrt(x**2 + y**2 + 1), 0)
    v, u = np.mgrid[:450, :448]
    at = (u - 223.5) / 192, (v - 224.5) / 192
    depth = griddata((x[known], y[known]), metres[known], at, "nearest")
    save([np.where(np.hypot(*at) < 1.5, depth, 0)], intrinsics(192.0, 192.0, 223.5, 224.5))


def nyu():
    """The first test image of the NYU set: a PrimeSense camera (as a Kinect v1), millimetres in
    green (upper eight bits) and blue, 640 x 480; K is the set's. As published it is mirrored (the
    colour image shows a shirt's writing), which is undone: a left hand.
    """
    (image,) = images("depth_1_0000001.png")
    metres = (256.0 * image[:, ::-1, 1] + image[:, ::-1, 0]) / 1000
    save([np.where(metres < 2, metres, 0)], intrinsics(588.04, 587.08, 639 - 320.0, 240.0))


def sr305():
    """Two sequences in part, of one person at 0.6 m: an Intel RealSense SR305, 640 x 480, 16 bit,
    steps of 0.125 mm; unit and K are the repository's (datasets/custom/readme.txt). labels: the
    first shows an open hand that turns, the second hands with some fingers bent.
    """
    paths = [f"20210326-230536/{n}.png" for n in range(30, 171, 20)]
    paths += [f"20210326-231615/{n}.png" for n in range(0, 221, 20) if n != 120]
    depth = np.stack(images(*(f"datasets/custom/{path}" for path in paths))) * 0.000125
    labels = np.array(["palm"] * 8 + ["other"] * 11)
    save(depth, intrinsics(476.007, 476.007, 313.683, 242.755), labels=labels)


def cup():
    """A person moves a ball, a spoon and a cup on a table, seen from above: a stereo camera that is
    not named, 640 x 360, 16 bit, millimetres. K makes the ball round (400 pixels, give or take 50).
    The colour images lie some 24 pixels to the left.
    """
    depth = images(*(f"depth/{n:05d}.png" for n in range(207)))
    save(np.stack(depth).astype(np.float32) / 1000, intrinsics(400.0, 400.0, 320, 180), fps=25.0)


def hadjust():
    """Eight poses of one right hand before a face: an Intel RealSense (by its K), 320 x 240, 16
    bit, millimetres; K is the repository's (main/MAIN_CALIBRATE.m). labels: what each shows.
    """
    depth = np.stack(images(*(f"data/USER1/{n}/depth.png" for n in range(1, 9)))) / 1000
    labels = np.array("palm other other other palm palm other palm".split())
    save(depth, intrinsics(287.26, 287.26, 160, 120), labels=labels)


def room(pattern, K, fps=1.0, commit="HEAD"):
    """Depth images without any hand, 16 bit, millimetres, 65535 = no reading, in the order of the
    numbers in their names. pattern: of their paths.
    """
    command = ["git", "-C", git_dir, "ls-tree", "-r", "--name-only", commit]
    names = subprocess.run(command, capture_output=True, check=True, text=True).stdout.split("\n")
    paths = sorted(
        (name for name in names if re.fullmatch(pattern, name)),
        key=lambda name: [*map(int, re.findall(r"\d+", name))],
    )
    depth = np.stack([image.astype(np.float32) for image in images(*paths, commit=commit)]) / 1000
    depth[depth > 10] = 0
    save(depth, K, fps)


ROOMS = {
    "arm": (r"(images|validation)/depth_\d+\.png", intrinsics(612.0, 612.0, 328.5, 247.2)),
    "bin": (
        r"old-version/data/sample/.*depth\.png",
        intrinsics(615.2, 615.2, 298.4, 247.5),
        30.0,
    ),
    "board": (
        # Not those in which somebody passes.
        r"data/iros_data(/depth_frame00(01|02|04|05|07|08|09|14|16|17|22)"
        r"|2/depth_frame00(02|08|09|11|14|16|17|22))\.png",
        intrinsics(529.3, 531.3, 467.0, 273.3),
    ),
    "boxes": (r"data/(depth/\d+|test_img_depth)\.png", intrinsics(617.2, 617.5, 317.4, 246.0)),
    "desk": (r"data/depth/.*\.png", intrinsics(425.0, 425.0, 424.0, 240.0)),
    "floor": (r"depth/.*\.png", intrinsics(385.0, 385.0, 319.5, 239.5)),
    "home": (
        r"data/(kitchen/depth_[0-4]|depth_[45])\.png",  # in the others are persons
        intrinsics(600.0, 600.0, 424.0, 240.0),
        1.0,
        "17037da5",
    ),
    "kitchen": (
        r"data/frame-000(3\d\d|40\d|41\d|69\d|7\d\d|80\d)\.depth\.png",
        intrinsics(585.0, 585.0, 320.0, 240.0),
        30.0,
    ),
    "lamp": (
        # What is between these may show a hand.
        r"dataset/realsense/depth/0*(1[6-9]\d|2[0-2]\d|23[0-8]|3[1-5]\d|360|4[1-4]\d|45[0-5])\.png",
        intrinsics(610.4, 609.8, 312.0, 246.1),
        30.0,
    ),
    "marker": (r"depth/\d+\.png", intrinsics(920.0, 920.0, 640.0, 360.0)),
    "mug": (
        r"data/0000(0[0-69]|1\d|2[0-3])_depth\.png",  # 7 and 8 show a person
        intrinsics(571.6, 571.5, 316.0, 243.7),
    ),
    "office": (r"depths/.*\.png", intrinsics(615.0, 615.0, 320.0, 240.0), 30.0),
    "person": (r"a1/data/\d+_depth\.png", intrinsics(525.0, 525.0, 320.0, 240.0)),
    "phone": (r"depth/.*\.png", intrinsics(213.0, 213.0, 96.0, 128.0)),
    "plane": (
        r"dataset/realsense/depth/.*\.png",
        intrinsics(615.2, 615.5, 321.2, 244.2),
        30.0,
        "f374c160",
    ),
    "router": (r"data/depth_\d+\.png", intrinsics(425.8, 425.3, 425.9, 244.5)),
    "table": (r"data/depth/.*\.png", intrinsics(616.7, 616.9, 324.8, 238.0)),
    "workshop": (r"data/depth/.*\.png", intrinsics(385.0, 385.0, 319.5, 239.5), 30.0),
}
"""K is the repository's, as far as there is one; else (desk, floor, marker, office, phone, and
workshop) what such cameras usually have."""
CAMCUBE = {
    "counts": ("data", "palm fist thumb_up victory three four palm"),
    "group1": (
        "gesture-recognition/runFolder/groupe1",
        "palm three none fist four victory three four palm four three_no_thumb victory fist palm"
        " four three",
    ),
    "group3": (
        "gesture-recognition/runFolder/groupe3",
        "thumb_up pointing_thumb three four_thumb palm palm fist palm four three_no_thumb victory"
        " pointing palm four three_no_thumb victory pointing fist",
    ),
}
made = (adi_tof, bighand, cup, fpha, hadjust, hamer_depth, hololens, kinect1_room, nyu)
made += (r200_ceiling, sr305)
MAKERS = {one.__name__: one for one in made}
MAKERS |= {f"cvar_p{n}": lambda n=n: cvar(f"P{n}") for n in (1, 3, 4, 5, 6, 7)}
MAKERS |= {
    f"camcube_{name}": lambda given=given: camcube(*given) for name, given in CAMCUBE.items()
}
MAKERS |= {f"room_{name}": lambda given=given: room(*given) for name, given in ROOMS.items()}

if recording not in MAKERS:
    raise SystemExit(f"{__doc__}\nRECORDING is one of {', '.join(sorted(MAKERS))}")
MAKERS[recording]()
