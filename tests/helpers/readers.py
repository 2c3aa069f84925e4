"""Every reader of files, and a valid file of each kind made by the project's own writers."""

import json
import shutil
import zipfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from helpers import bags, videos
from helpers.data_sets import write
from helpers.tracking import ROOT, run
from hydra.utils import instantiate
from scipy.io import savemat

from toftrack.configuration import configuration_folder
from toftrack.configuration.compose import configuration, one_sentence
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.onnx_networks import onnx_file, read_session
from toftrack.detector.weights import DEFAULT_FILE, checksum, load_weights, save_weights
from toftrack.devices.replay import Replay, Sample
from toftrack.errors import ToftrackError
from toftrack.evaluation.datasets import DATA_SETS, open_data_set
from toftrack.evaluation.image_labels import read_labels
from toftrack.evaluation.labelling import LabelFile
from toftrack.frames.camera import Camera
from toftrack.gestures.files import NamedPose, read_poses, save_poses
from toftrack.hand.shape import HandShape, default_hand_shape
from toftrack.hand.skeleton import ANGLE_NAMES
from toftrack.output.files import LINES
from toftrack.output.run_folder import Run, read_run
from toftrack.pose_space.data.leap import leap_data
from toftrack.pose_space.data.pose_files import file_data
from toftrack.pose_space.files import fit_pose_space, load_pose_space, save_pose_space
from toftrack.programs.recover import recover
from toftrack.programs.report import read_runs
from toftrack.recordings.image_folder import write_image_folder
from toftrack.recordings.npz import Recording, write_recording
from toftrack.recordings.sr_frame import encode_frame
from toftrack.recordings.srs import SrsWriter
from toftrack.recordings.unfinished import Facts, UnfinishedRecording, compressed, recover_recording
from toftrack.views.labelling.page import LabelPage

HEIGHT, WIDTH, FRAMES = 24, 32, 3
_MOST_FRAMES = 4


@dataclass(frozen=True)
class Reader:
    """file: the one that is changed.  given: what the reader is given, that file or its folder."""

    name: str
    file: Path
    given: Path
    read: Callable[[Path], object]


def small_camera() -> Camera:
    return Camera(np.array([[40.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]]), WIDTH, HEIGHT)


def small_images() -> np.ndarray:
    """(FRAMES, HEIGHT, WIDTH) float32 metres: something near before a wall."""
    depth = np.full((FRAMES, HEIGHT, WIDTH), 1.5, np.float32)
    for number in range(FRAMES):
        depth[number, 6:18, 8 + number : 20 + number] = 0.5 + 0.01 * number
    return depth


def play(path: Path) -> None:
    """A recording as the tracker gets it, from its first frames."""
    with Replay(path, camera_file=_beside(path)) as device:
        for number, frame in enumerate(device):
            device.camera.rectify(frame.depth, frame.radial)
            device.camera.undistort_amplitude(frame.amplitude)
            if number + 1 == _MOST_FRAMES:
                break


def play_recovered(path: Path) -> None:
    """As `play`, of what is made of an unfinished recording; that itself stays."""
    copy = path.with_name("copy.npz.part")
    shutil.copy(path, copy)
    play(recover_recording(copy, overwrite=True)[0])


def _beside(path: Path) -> Path | None:
    """Recordings without a camera of their own lie in a folder with one."""
    camera = path.parent / "of_bare.json"
    return camera if camera.exists() else None


def read_whole_run(folder: Path) -> None:
    """A finished run as reports and figures read it."""
    run_there: Run = read_run(folder)
    run_there.estimates(0)
    run_there.estimates(len(run_there) - 1)
    run_there.likelihood()
    run_there.segmentation()


def write_readers(folder: Path, whole: bool = True) -> list[Reader]:
    """Valid files in folders of their own below a folder, and who reads them.

    whole: also what takes seconds to make: a run, a bag where rosbags is installed, data sets.
    """
    readers = [*_recordings(folder), *_small_files(folder), *_configurations(folder)]
    if whole:
        readers += [*_runs(folder), *_data_sets(folder)]
        if find_spec("rosbags") is not None:
            readers += _bags(folder)
    return readers


def _new(folder: Path, name: str) -> Path:
    (folder / name).mkdir(parents=True)
    return folder / name


def _alone(name: str, file: Path, read: Callable[[Path], object]) -> Reader:
    return Reader(name, file, file, read)


def _recordings(folder: Path) -> list[Reader]:
    camera, depth = small_camera(), small_images()
    times = np.arange(FRAMES) / 25
    amplitude = np.full(depth.shape, 700, np.uint16)
    npz = _new(folder, "npz") / "recording.npz"
    facts = {"radial": False, "camera": camera, "fps": 25.0, "metadata": {"what": "a test"}}
    recording = Recording(depth=depth, amplitude=amplitude, timestamp_s=times, **facts)
    write_recording(npz, recording)
    unfinished = _new(folder, "unfinished") / "recording.npz.part"
    growing = UnfinishedRecording(unfinished)
    growing.begin(Facts(camera, False, True, 25.0, {"what": "a test"}))
    for number, images in enumerate(zip(depth, amplitude, strict=True)):
        seen, strength = (image.tobytes() for image in images)
        packed = seen, compressed(seen), strength, compressed(strength)
        growing.append(number, times[number], packed)
    growing.close()
    srs = _new(folder, "srs") / "recording.srs"
    frame = encode_frame(np.full((144, 176), 0.8, np.float32), None, 7.5)
    with closing(SrsWriter(srs)) as writer:
        for time in times[:2]:
            writer.append(frame, float(time))
    png = folder / "png"
    write_image_folder(png, recording)
    stack = _new(folder, "npy") / "stack.npy"
    words = np.rint(1000 * depth).astype(np.uint16)
    np.save(stack, words)
    grey = videos.write_grey(_new(folder, "grey") / "grey.mkv", words)
    pages = _new(folder, "tif") / "stack.tif"
    cv2.imwritemulti(str(pages), list(words))
    matlab = _new(folder, "mat") / "stack.mat"
    savemat(matlab, {"depth": words}, do_compression=True)
    bare_ones = [stack, grey, pages, matlab]
    zipped = _new(folder, "zip") / "images.zip"
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (*png.iterdir(), pages):
            archive.write(file, f"take/{file.name}")
    single = _new(folder, "float") / "1.tif"
    cv2.imwrite(str(single), depth[0])
    inside = {"folder: a float TIFF": single}
    if find_spec("h5py") is not None:
        import h5py

        bare_ones.append(_new(folder, "h5") / "stack.h5")
        with h5py.File(bare_ones[-1], "w") as target:
            target.create_dataset("depth", data=words, compression="gzip")
    if find_spec("OpenEXR") is not None:
        import OpenEXR

        inside["folder: an EXR"] = _new(folder, "exr") / "1.exr"
        OpenEXR.File({}, {"Z": depth[0]}).write(str(inside["folder: an EXR"]))
    for file in inside.values():
        camera.save(file.with_name("camera.json"))
    for bare in bare_ones:
        camera.save(bare.parent / "of_bare.json")
    about = videos.calibration(np.array([[252.0, 0, 160], [0, 252, 144], [0, 0, 1]]), 512, (96, 90))
    large = np.tile(words[:1], (1, 12, 10))  # a mode of its camera
    kinect = videos.write_kinect(_new(folder, "kinect") / "kinect.mkv", large, large, about)
    return [
        _alone("recording .npz", npz, play),
        _alone("recording .srs", srs, play),
        _alone("unfinished recording", unfinished, play_recovered),
        Reader("PNG folder: camera.json", png / "camera.json", png, play),
        Reader("PNG folder: an image", png / "depth_000000.png", png, play),
        Reader("PNG folder: timestamps.txt", png / "timestamps.txt", png, play),
        *(_alone(f"bare {bare.suffix}", bare, play) for bare in bare_ones),
        _alone("images .zip", zipped, play),
        *(Reader(name, file, file.parent, play) for name, file in inside.items()),
        _alone("Kinect's video", kinect, play),
    ]


def _small_files(folder: Path) -> list[Reader]:
    small = _new(folder, "small")
    random = np.random.default_rng(0)
    poses = [NamedPose(name, np.radians(random.uniform(0, 9, 21))) for name in ("one", "two")]
    save_poses(small / "gestures.json", poses)
    row = ",".join(f"{angle:.2f}" for angle in np.degrees(poses[0].angles_rad))
    header = ",".join(ANGLE_NAMES)
    (small / "gestures.csv").write_text(f"# units: degrees\nname,{header}\none,{row}\n")
    rows = "".join(f"{row},a\n" for _ in range(3))
    (small / "poses.csv").write_text(f"# units: degrees\n{header},label\n{rows}")
    angles = random.uniform(0, 20, (4, 21))
    np.savez(small / "poses.npz", angles=angles, units="degrees", labels=["a", "b", "a", "b"])
    save_pose_space(fit_pose_space("pca", 2), small / "pose_space.npz")
    default_hand_shape().save(small / "hand_shape.json")
    small_camera().save(small / "camera.json")
    joints = 50.0 * random.standard_normal((6, 5, 4, 3)).astype(np.float32)
    np.savez(
        small / "leap.npz",
        joints_mm=joints,
        is_left=np.zeros(6, bool),
        seq_name=["a.json.lz", "b.json.lz"],
        seq_len=[3, 3],
    )
    networks = PoseNet(4), Finder(4)
    for parameter in (one for network in networks for one in network.parameters()):
        parameter.data.zero_()  # takes hardly any room
    save_weights(small / "weights.npz", *networks, {"steps": 1})
    shutil.copy(onnx_file(DEFAULT_FILE, "finder"), small / "weights.finder.onnx")
    labels = LabelFile(small / "labels.json", "a.npz", (WIDTH, HEIGHT), 9, "left")
    labels.begin([2, 5])
    labels.set_point(5, "index_tip", [1, 2, "visible"])
    labels.set_gesture(2, "palm")
    stills = {"image_size": [4, 3], "side": "left", "shown_frames": 2, "images": [1, 2]}
    stills |= {"called": {"1": ["palm"], "2": ["other", ""]}}
    (small / "stills.json").write_text(json.dumps(stills))
    readers: dict[str, Callable[[Path], object]] = {
        "labels.json": go_on_labelling,
        "stills.json": read_labels,
        "gestures.json": read_poses,
        "gestures.csv": read_poses,
        "poses.csv": lambda path: file_data(str(path)),
        "poses.npz": lambda path: file_data(str(path)),
        "pose_space.npz": load_pose_space,
        "hand_shape.json": HandShape.load,
        "camera.json": Camera.load,
        "leap.npz": lambda path: leap_data(str(path), None, 1e3),
        "weights.npz": read_weights,
        "weights.finder.onnx": lambda path: read_session(path, path.with_name("weights.npz")),
    }
    return [_alone(name, small / name, read) for name, read in readers.items()]


def go_on_labelling(path: Path) -> None:
    """As `toftrack label` continues a file, and `benchmark accuracy` reads it."""
    read_labels(path)
    labels = LabelFile(path, "a.npz", (WIDTH, HEIGHT), 9, None)
    labels.begin([2, 5, 7])
    labels.set_point(2, "wrist", [3, 4, "guessed"])
    with closing(LabelPage(labels, (), (), 0)) as page:
        json.dumps(page.about(), allow_nan=False)
    assert labels.labelled() <= len(labels.frames)
    read_labels(path)


def _configurations(folder: Path) -> list[Reader]:
    """Composed only: what they name is executed by whoever uses them."""
    own, job = folder / "conf", _new(folder, "sweep") / "0"
    shutil.copytree(configuration_folder(), own)
    (job / ".hydra").mkdir(parents=True)
    (job / ".hydra" / "overrides.yaml").write_text("- filter.particles=100\n- seed=1\n")
    (job / "summary.json").write_text('{"frames": 3, "metrics": {"mean_mm": 5.5}}')
    parts = folder / "plugins"
    shutil.copytree(ROOT / "docs" / "examples" / "plugins", parts)
    chosen = {f"{path.parent.name}={path.stem}": path for path in sorted(parts.glob("*/*.yaml"))}
    return [
        *(Reader(f"part {choice}", path, path, make_part) for choice, path in chosen.items()),
        Reader("config.yaml", own / "config.yaml", own, compose),
        Reader("group: a .yaml", own / "segmentation" / "nearest.yaml", own, compose),
        Reader("overrides.yaml", job / ".hydra" / "overrides.yaml", job.parent, read_runs),
    ]


def compose(folder: Path) -> None:
    """A configuration of one's own."""
    configuration("seed=1", config_dir=folder)


def make_part(path: Path) -> None:
    """The part that a file in a folder of one's own describes, where that takes no time."""
    group = path.parent.name
    config = configuration(f"{group}={path.stem}", config_dir=path.parents[1])
    if group == "likelihood":
        with one_sentence():
            instantiate(config.likelihood)


def read_weights(path: Path) -> None:
    """Weights as they are, and with the checksum set right, which anybody can do."""
    try:
        load_weights(path)
    except ToftrackError as error:
        if "checksum" not in str(error):
            raise
        try:
            with np.load(path, allow_pickle=False) as content:
                arrays = dict(content)
        except Exception:  # it is damaged in another way, too
            raise error from None
        metadata = json.loads(arrays.pop("metadata").item())
        metadata["sha256"] = checksum(arrays)
        right = path.with_name("right.npz")
        np.savez(right, metadata=np.array(json.dumps(metadata)), **arrays)
        load_weights(right)


def _runs(folder: Path) -> list[Reader]:
    quick = ("filter.particles=50",)
    there = _new(folder, "run")
    with Sample(stop=2) as device:
        run(there, device, *quick, "view=none")
    killed = folder / "killed"
    shutil.copytree(there, killed)
    files = ("track.npz", "run.json", "summary.json", "hand_shape.json")
    return [
        *(Reader(f"run: {name}", there / name, there, read_whole_run) for name in files),
        *(Reader(f"killed run: {n}", killed / n, killed, recover) for n in (LINES, "run.json")),
    ]


def _data_sets(folder: Path) -> list[Reader]:
    readers = []
    for name in DATA_SETS:
        write(name, there := folder / name, 2)
        files = {path.suffix: path for path in sorted(there.rglob("*.*"))}
        reader = partial(_read_data_set, name)
        readers += [Reader(f"{name}: {suffix}", files[suffix], there, reader) for suffix in files]
    return readers


def _read_data_set(name: str, folder: Path) -> None:
    _, sequences = open_data_set(name, folder)
    for sequence in sequences:
        for image in sequence.images[:_MOST_FRAMES]:
            sequence.read(image)


def _bags(folder: Path) -> list[Reader]:
    messages = bags.recording(list(small_images()), small_camera())
    readers = []
    for kind in bags.KINDS:
        path = bags.write_bag(_new(folder, f"{kind}_bag"), kind, messages)
        files = [path] if path.is_file() else sorted(path.iterdir())
        readers += [Reader(f"bag .{kind}: {file.suffix}", file, path, play) for file in files]
    return readers
