"""The vendor's library: against a stand-in that is compiled here."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from helpers.settings import mesa_settings, persistence_settings, sr3000

from toftrack.devices.sr3000.device import Sr3000
from toftrack.errors import ToftrackError

SOURCE = r"""
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
/* Counts frames; the environment tells which call goes wrong. */
typedef struct { uint16_t images[2][144 * 176]; int acquired; } Camera;
static int opened = 0;
static int wrong(const char *what) {
    const char *given = getenv("STAND_IN_FAULT");
    if (!given) return 0;
    while (*what && *given == *what) { ++given; ++what; }
    return *given == 0 && *what == 0;
}
static void log_call(const char *name, int value) {
    const char *path = getenv("STAND_IN_LOG");
    FILE *file = path ? fopen(path, "a") : 0;
    if (file) { fprintf(file, "%s %d\n", name, value); fclose(file); }
}
int SR_OpenUSB(Camera **camera, unsigned serial) {
    log_call("open", (int)serial);
    if (wrong("open") || (wrong("gone") && opened > 0 && opened < 3)) { ++opened; return -1; }
    ++opened;
    *camera = calloc(1, sizeof(Camera));
    return 1;
}
int SR_Close(Camera *camera) { log_call("close", 0); free(camera); return 0; }
int SR_Acquire(Camera *camera) {
    int i;
    ++camera->acquired;
    if (wrong("acquire")) return -5;
    if (wrong("once") && camera->acquired == 3) return -5;
    if (wrong("gone") && opened == 1 && camera->acquired > 3) return -5;
    for (i = 0; i < 144 * 176; ++i) {
        camera->images[0][i] = (uint16_t)(i + camera->acquired);
        camera->images[1][i] = (uint16_t)(7 * camera->acquired);
    }
    return 101376;
}
void *SR_GetImage(Camera *camera, unsigned char index) {
    return wrong("image") ? 0 : camera->images[index];
}
int SR_GetRows(Camera *camera) { (void)camera; return wrong("rows") ? 200 : 144; }
int SR_GetCols(Camera *camera) { (void)camera; return 176; }
int SR_SetTimeout(Camera *camera, int ms) { (void)camera; log_call("timeout", ms); return 0; }
int SR_SetIntegrationTime(Camera *c, unsigned char n) { (void)c; log_call("time", n); return 0; }
int SR_SetAmplitudeThreshold(Camera *c, uint16_t n) { (void)c; log_call("floor", n); return 0; }
int SR_SetMode(Camera *c, int n) { (void)c; log_call("mode", n); return 0; }
#ifndef INCOMPLETE
int SR_SetModulationFrequency(Camera *c, int code) {
    (void)c;
    log_call("modulation", code);
    return wrong("modulation") ? -1 : 0;
}
#endif
"""

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


Libraries = dict[str, Path]


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> Libraries:
    if COMPILER is None:
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("library")
    (folder / "mesa.c").write_text(SOURCE)
    paths = {}
    for name, flags in {"whole": [], "incomplete": ["-DINCOMPLETE"]}.items():
        paths[name] = folder / f"lib{name}.so"
        command = [COMPILER, "-shared", "-fPIC", *flags, "mesa.c", "-o", str(paths[name])]
        subprocess.run(command, cwd=folder, check=True)
    return paths


def camera(library: Path | str, **changes: object) -> Sr3000:
    persistence = persistence_settings(
        first_frame_s=0.3, give_up_s=0.5, backoff_s=0.01, longest_backoff_s=0.05, reopen_after=2
    )
    settings = {"keep": "every", "stop": 5} | changes
    mesa = mesa_settings(library=str(library), timeout_ms=50)
    return sr3000("libmesasr", libmesasr=mesa, persistence=persistence, **settings)


def test_reads_frames_and_sets_the_camera_up(
    libraries: Libraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "calls"
    monkeypatch.setenv("STAND_IN_LOG", str(log))
    settings = {"modulation_mhz": 30, "integration_time": 12, "amplitude_threshold": 3}
    with camera(libraries["whole"], serial="0x2a", **settings) as device:
        frames = list(device)
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    for number, frame in enumerate(frames, start=1):
        words = frame.depth.ravel()[:100] / (device.exposure.range_m / 0xFFFF)
        np.testing.assert_allclose(words, np.arange(100) + number, atol=1e-3)
        assert (frame.amplitude == 7 * number).all()
    calls = "open 42, timeout 50, mode 5, modulation 1, floor 3, time 12, close 0"
    assert log.read_text().splitlines() == calls.split(", ")


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("open", "found no camera with the serial number 0x4000002f that"),
        ("rows", "176x200"),
        ("modulation", "SR_SetModulationFrequency"),
        ("acquire", "sent no frame.*SR_Acquire"),
    ],
)
def test_what_goes_wrong_is_reported(
    libraries: Libraries, fault: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STAND_IN_FAULT", fault)
    with pytest.raises(ToftrackError, match=words):
        with camera(libraries["whole"], serial="0x4000002f") as device:
            list(device)


@pytest.mark.parametrize(("fault", "unanswered"), [("once", 1), ("gone", 2)])
def test_recovers(
    libraries: Libraries, fault: str, unanswered: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STAND_IN_FAULT", fault)
    # The stand-in counts how often it was opened, so each fault needs a copy of its own.
    library = libraries["whole"].with_name(f"lib{fault}.so")
    shutil.copy(libraries["whole"], library)
    with camera(library) as device:
        assert [frame.index for frame in device] == [0, 1, 2, 3, 4]
    assert device.counts.unanswered == unanswered


def test_a_library_that_lacks_a_function_is_reported(libraries: Libraries) -> None:
    with pytest.raises(ToftrackError, match="no function SR_SetModulationFrequency"):
        camera(libraries["incomplete"])


@pytest.mark.parametrize(
    ("serial", "words"),
    [
        (None, "libnowhere.so.*vendor's package.*transport=usb"),
        ("SN-12", "SN-12 is not a number.*as 0x"),
    ],
)
def test_no_library_and_no_number_are_reported(serial: str | None, words: str) -> None:
    with pytest.raises(ToftrackError, match=words):
        camera("libnowhere.so", serial=serial)
