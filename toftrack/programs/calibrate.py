"""Calibrate a depth camera from a recording of a chequerboard:
`toftrack calibrate RECORDING --board 7x5 --square 0.03`.

Move a flat chequerboard about before the camera: wholly in view, near and far over the distances
that matter, turned to all sides, slowly. The camera file serves every device: `camera.file=FILE`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from toftrack.errors import ToftrackError, reported_errors
from toftrack.files.json_text import write_json
from toftrack.files.safe_files import check_replaceable, write_whole
from toftrack.frames import calibration
from toftrack.frames.calibration import DepthFit, DepthPairs, Lens, View
from toftrack.frames.camera import Camera
from toftrack.programs.command_line import plain_parser
from toftrack.recordings.bare import Given
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.sr_frame import DEFAULT_MODULATION_MHZ
from toftrack.recordings.store import open_with_own_camera
from toftrack.views.figures import chart
from toftrack.views.pictures import write_picture

_PICTURES = 12
_LENS = "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tauX tauY".split()
_SEARCHED = 24
"""So many frames are looked at for a board before all are searched for its corners: 5 s."""


def main(arguments: Sequence[str]) -> None:
    """Parse the command line, calibrate, and write the files. Raises ToftrackError."""
    parser = plain_parser("toftrack calibrate", __doc__)
    add, number = parser.add_argument, parser.add_number
    add("recording", help=".srs, .npz with amplitude, or a folder")
    add("--board", required=True, help="inner corners, columns x rows, as 7x5")
    metres = ", in metres (0.03 for 30 mm)"
    number("--square", 0, 0.99, remedy=metres, required=True, help="side of a square, m")
    add("--out", default="camera.json", help="the camera file to write")
    add("--report", help="folder of report and pictures (default: beside OUT)")
    add("--camera", help="camera file to start from instead of the recording's")
    add("--keep-lens", action="store_true", help="correct the depth only, trust the lens")
    number("--frames", 1, whole=True, default=80, help="use at most this many (80)")
    mhz, about = DEFAULT_MODULATION_MHZ, "MHz, of a .srs that does not state its range"
    add("--modulation", type=int, default=mhz, help=about)
    options = parser.parse_args(arguments)
    board, square_m = _board(options.board), options.square
    out = Path(options.out).expanduser()
    with reported_errors(f"the camera file '{out}' cannot be written", "choose another place"):
        check_replaceable(out)  # before minutes of work
        os.stat(out.absolute().parent)
    given = Given(camera_file=options.camera, modulation_mhz=options.modulation)
    with closing(open_with_own_camera(options.recording, given)) as store:
        size = store.camera.width, store.camera.height
        start = given.camera(*size, "the recording") or store.camera
        if store.image(0)[1] is None:
            raise ToftrackError(
                "the recording has no amplitude images, in which the chequerboard is found; record "
                "them, too"
            )
        spread = np.linspace(0, len(store) - 1, options.frames)
        numbers = np.unique(spread.round().astype(int))
        fit = calibration.known_lens if options.keep_lens else calibration.fit_lens
        lens = fit(_views(store, board, numbers), board, square_m, start)
        images = []
        for view in lens.views:
            depth, amplitude = store.image(view.index)
            assert amplitude is not None  # as of the first frame
            # A recording of Z was made with the recording's own camera: that is taken back.
            images.append((store.camera.to_radial(depth, store.radial), amplitude))
    pairs = calibration.depth_pairs(lens, board, square_m, images)
    found = calibration.fit_depth(pairs)
    camera = replace(
        lens.camera, depth_polynomial=found.polynomial, depth_polynomial_range_m=found.range_m
    )
    folder = Path(options.report).expanduser() if options.report else out.with_suffix(".report")
    camera.save(out)
    facts = _facts(start, camera, lens, pairs, found, len(numbers))
    text = _report(facts)
    what = f"the report folder '{folder}' cannot be written"
    with reported_errors(what, "choose another with --report"):
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "report.txt", text + "\n")
        write_json(folder / "report.json", facts)
        write_picture(folder / "corners.png", _corner_sheet(lens.views, images, board))
        chart.write_figures(folder, [("depth_error.png", lambda: _error_plot(facts))])
    print(text)
    print(f"camera file: {out}\nreport:      {folder}")


def _views(store: FrameStore, board: tuple[int, int], numbers: np.ndarray) -> list[View]:
    """The frames of these numbers that show the board. Raises ToftrackError soon where none does,
    for searching a frame in vain takes seconds."""
    spread = np.unique(np.linspace(0, len(numbers) - 1, _SEARCHED).round().astype(int))
    # From the middle outwards: at both ends somebody still carries the board.
    places = sorted(spread, key=lambda at: abs(at - len(numbers) / 2))
    if not any(calibration.shows_board(_amplitude(store, numbers[at]), board) for at in places):
        raise ToftrackError(
            f"no {board[0]}x{board[1]} chequerboard was seen in any of {len(places)} frames over "
            "the recording; it must be wholly in view, and --board is its inner corners, columns x "
            "rows (a board of 8x6 squares is 7x5)"
        )
    views: list[View] = []
    for number in tqdm(numbers, unit=" frames", desc="corners", file=sys.stderr, disable=None):
        corners = calibration.find_corners(_amplitude(store, number), board)
        if corners is not None:
            views.append(View(int(number), corners))
    return views


def _amplitude(store: FrameStore, number: int) -> np.ndarray:
    amplitude = store.image(int(number))[1]
    assert amplitude is not None  # `main` made sure that there are some
    return amplitude


def _report(facts: dict[str, Any]) -> str:
    """What was found, before and after, in lines."""
    before, after = facts["before"], facts["after"]
    lines = [
        f"chequerboard found in {facts['frames_used']} of {facts['frames_searched']} frames, "
        f"{facts['nearest_m']:.2f} to {facts['farthest_m']:.2f} m away",
        f"corners reprojected to {facts['reprojection_px']:.3f} px rms",
        "                      before      after",
    ]
    for name in ("fx", "fy", "cx", "cy"):
        lines.append(f"{name:<18}{before[name]:>10.2f} {after[name]:>10.2f} px")
    # Lenses before and after may have numbers of coefficients of their own; the rest are zeros.
    for name, old, new in zip_longest(_LENS, before["distortion"], after["distortion"]):
        if old is not None or new is not None:
            lines.append(f"{name:<18}{old or 0:>10.4f} {new or 0:>10.4f}")
    for key, name in (("board_rms_mm", "depth, boards"), ("pixel_rms_mm", "depth, pixels")):
        lines.append(f"{name:<18}{before[key]:>10.2f} {after[key]:>10.2f} mm rms")
    errors = ", ".join(f"{o}: {mm:.2f}" for o, mm in facts["validation_mm"].items())
    lines.append(f"depth polynomial of order {facts['order']} (left-out frames, mm rms: {errors})")
    return "\n".join(lines)


def _facts(
    start: Camera, camera: Camera, lens: Lens, pairs: DepthPairs, fit: DepthFit, searched: int
) -> dict[str, Any]:
    """Of report.json.  searched: how many frames were."""

    def one(camera: Camera, polynomial: tuple[float, ...]) -> dict[str, Any]:
        distance, error = calibration.frame_errors(pairs, polynomial)
        pixel = calibration.pixel_errors(pairs, polynomial)
        return {
            "fx": camera.K[0, 0],
            "fy": camera.K[1, 1],
            "cx": camera.K[0, 2],
            "cy": camera.K[1, 2],
            "distortion": camera.distortion.tolist(),
            "board_rms_mm": 1000 * float(np.sqrt(np.mean(error**2))),
            "pixel_rms_mm": 1000 * float(np.sqrt(np.average(pixel**2, weights=pairs.weight))),
            "board_distance_m": distance.tolist(),
            "board_error_mm": (1000 * error).tolist(),
        }

    return {
        "frames_searched": searched,
        "frames_used": len(lens.views),
        "nearest_m": float(pairs.true_m.min()),
        "farthest_m": float(pairs.true_m.max()),
        "reprojection_px": float(np.sqrt(np.mean(lens.errors_px**2))),
        "order": fit.order,
        "validation_mm": {str(order): mm for order, mm in fit.validation_mm.items()},
        "before": one(start, ()),
        "after": one(camera, fit.polynomial),
    }


def _board(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) == 2 and all(part.isdecimal() for part in parts):
        columns, rows = map(int, parts)
        if 3 <= columns <= 50 and 3 <= rows <= 50:
            return columns, rows
    raise ToftrackError(
        f"--board {text} is not COLUMNSxROWS of inner corners, each from 3 to 50; a board of 8x6 "
        "squares is 7x5"
    )


def _corner_sheet(
    views: Sequence[View], images: Sequence[tuple[np.ndarray, np.ndarray]], board: tuple[int, int]
) -> np.ndarray:
    """(H, W, 3) uint8 BGR: some of the images' amplitudes, (H, W), with the corners drawn in."""
    columns, scale, tiles = 4, 2, []
    for at in np.unique(np.linspace(0, len(views) - 1, _PICTURES).round().astype(int)):
        root = np.sqrt(images[at][1].astype(np.float32))
        grey = (255 * root / max(float(root.max()), 1.0)).astype(np.uint8)
        shown = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        tile = cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR)
        places = ((views[at].corners_px + 0.5) * scale - 0.5).astype(np.float32).reshape(-1, 1, 2)
        cv2.drawChessboardCorners(tile, board, places, True)
        tiles.append(tile)
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[at : at + columns]) for at in range(0, len(tiles), columns)]
    return np.vstack(rows)


def _error_plot(facts: dict[str, Any]) -> np.ndarray:
    """(480, 720, 3) uint8 BGR: the boards' mean depth errors over their distance, of a report."""
    figure = chart.new_figure(720, 480)
    axes = figure.subplots()
    chart.label(axes, "true distance, m", "mean error of each board, mm")
    axes.axhline(0, color=chart.GREY, linewidth=1)
    distances_m = facts["before"]["board_distance_m"]
    for name, colour in (("before", chart.VERMILLION), ("after", chart.GREEN)):
        errors_mm = facts[name]["board_error_mm"]
        axes.plot(distances_m, errors_mm, "o", color=colour, markersize=4, label=name)
    axes.legend()
    return chart.picture_of(figure)
