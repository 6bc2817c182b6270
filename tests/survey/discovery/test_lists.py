"""Anchors and times of photos are read in the forms in which people have them, or `init` gives the command to type."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from tests.simulated.phone_survey import write_log, write_photos

from rangesfm.cli import main
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.sfm.image_times import find_image_times, list_images
from rangesfm.survey.inputs import read_ranging_inputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey

Place = tuple[float, float, float]
ROOM: dict[str, Place] = {
    "A1": (0.5, 1.25, 2.0),
    "A2": (8.0, 1.5, 2.5),
    "A3": (8.25, 7.0, 2.5),
    "A4": (0.0, 7.5, 1.0),
}


def moved(x_m: float, y_m: float, z_m: float) -> dict[str, Place]:
    """Return the room in a grid that begins at a place."""
    return {name: (x + x_m, y + y_m, z + z_m) for name, (x, y, z) in ROOM.items()}


LOCAL_GRID, SWISS = moved(5000, 2000, 100), moved(2600000, 1200000, 540)


def rows(
    text: str, places: dict[str, Place] = ROOM, *, scale: float = 1.0, comma: bool = False, decimals: int = 3
) -> str:
    """Return a line for each anchor; the text has {id}, {x}, {y} and {z}."""
    lines = []
    for name, place in places.items():
        numbers = {axis: f"{scale * value:.{decimals}f}" for axis, value in zip("xyz", place)}
        numbers = {axis: number.replace(".", ",") if comma else number for axis, number in numbers.items()}
        lines.append(text.format(id=name, n=name[1:], **numbers))
    return "\n".join(lines) + "\n"


def gsi(width: int, unit: int, per_metre: float) -> str:
    mark = "*" if width == 16 else ""
    lines = []
    for k, (name, place) in enumerate(LOCAL_GRID.items(), 1):
        words = [f"{mark}11{k:04d}+{name:0>{width}}"]
        words += [f"{81 + k}..1{unit}+{round(value * per_metre):0{width}d}" for k, value in enumerate(place)]
        lines.append(" ".join(words))
    return "\r\n".join(lines) + "\r\n"


def swiss(metres: float) -> str:
    return f"{metres:,.2f}".replace(",", "'")


# For each file: its name, its content, the positions in it, and the beginning of the choice that is right if `init` has
# to ask.
ANCHOR_FILES: dict[str, tuple[str, str | bytes, dict[str, Place], str | None]] = {
    "canonical": ("anchors.csv", "anchor_id,x_m,y_m,z_m\n" + rows("{id},{x},{y},{z}"), ROOM, None),
    "small letters": ("a.txt", "id x y z\n" + rows("{id} {x} {y} {z}"), ROOM, None),
    "English points": ("points.csv", "Point,East,North,Height\n" + rows("{id},{x},{y},{z}"), ROOM, None),
    "north before east": (
        "export.csv",
        "Point ID,Northing,Easting,Elevation,Code,Date,Time\n"
        + rows("{id},{y},{x},{z},ANC,2026-05-04,10:00:0{n}", LOCAL_GRID),
        LOCAL_GRID,
        None,
    ),
    "German spreadsheet": (
        "Festpunkte.csv",
        ("Punkt;Rechtswert;Hochwert;Höhe\n" + rows("{id};{x};{y};{z}", comma=True)).encode("cp1252"),
        ROOM,
        None,
    ),
    "semicolons and a byte order mark": (
        "anchors.csv",
        ("\ufeffAnchor;X;Y;Z\n" + rows("{id};{x};{y};{z}", comma=True)).replace("\n", "\r\n"),
        ROOM,
        None,
    ),
    "canonical names, decimal commas": (
        "anchors.csv",
        "anchor_id;x_m;y_m;z_m\n" + rows("{id};{x};{y};{z}", comma=True),
        ROOM,
        None,
    ),
    "units in brackets": ("a.csv", "Anchor ID,X [m],Y [m],Z [m]\n" + rows("{id},{x},{y},{z}"), ROOM, None),
    "millimetres": ("a.csv", "name,x_mm,y_mm,z_mm\n" + rows("{id},{x},{y},{z}", scale=1e3, decimals=0), ROOM, None),
    "units in a second row": ("a.csv", "Point,E,N,H\n,cm,cm,cm\n" + rows("{id},{x},{y},{z}", scale=100), ROOM, None),
    "tabs": ("a.tsv", "Station\tEasting\tNorthing\tElevation\n" + rows("{id}\t{x}\t{y}\t{z}"), ROOM, None),
    "Unicode text of a spreadsheet": (
        "anker.txt",
        ("Anker\tX\tY\tZ\n" + rows("{id}\t{x}\t{y}\t{z}", comma=True)).encode("utf-16"),
        ROOM,
        None,
    ),
    "French": ("balises.csv", "Ancre;Est;Nord;Altitude\n" + rows("{id};{x};{y};{z}", comma=True), ROOM, None),
    "French with a title": (
        "points.csv",
        "Chantier: halle 3\n\nPoint;X (m);Y (m);Z (m);Remarque\n" + rows("{id};{x};{y};{z};mur", comma=True) + ";;;;\n",
        ROOM,
        None,
    ),
    "thousands set apart": (
        "lv95.csv",
        "Punktname;Ost;Nord;Höhe\n"
        + "".join(f"{name};{swiss(x)};{swiss(y)};{z:.2f}\n" for name, (x, y, z) in SWISS.items()),
        SWISS,
        None,
    ),
    "quoted decimal commas": ("a.csv", "Anker,X,Y,Z\n" + rows('{id},"{x}","{y}","{z}"', comma=True), ROOM, None),
    "units after the numbers": ("a.csv", "Anchor;X;Y;Z\n" + rows("{id};{x} m;{y} m;{z} m", comma=True), ROOM, None),
    "numbered rows": ("a.csv", "Nr;Name;X;Y;Z\n" + rows("{n};{id};{x};{y};{z}"), ROOM, None),
    "records": (
        "anchors.json",
        "[" + ",".join(f'{{"id": "{name}", "x": {x}, "y": {y}, "z": {z}}}' for name, (x, y, z) in ROOM.items()) + "]",
        ROOM,
        None,
    ),
    "GSI-8": ("job1.gsi", gsi(8, 0, 1e3), LOCAL_GRID, None),
    "GSI-16": ("job2.gsi", gsi(16, 8, 1e5), LOCAL_GRID, None),
    "a room without names": ("anchors.txt", rows("{id} {x} {y} {z}"), ROOM, None),
    "PNEZD": ("job.txt", rows("{id} {y} {x} {z} ANCHOR", LOCAL_GRID), LOCAL_GRID, "if they are north, east, height"),
    "PNEZ with commas": ("job.csv", rows("{id},{y},{x},{z}", LOCAL_GRID), LOCAL_GRID, "if they are north, east"),
    "PENZ": ("job.csv", rows("{id},{x},{y},{z}", LOCAL_GRID), LOCAL_GRID, "if the numbers are x, y, z or east"),
    "geodetic axes": ("p.csv", "Punkt;Y;X;H\n" + rows("{id};{x};{y};{z}", comma=True), ROOM, "if X is north"),
    "two ids": ("a.csv", "ID,Anchor,X,Y,Z\n" + rows("0x{n},{id},{x},{y},{z}"), ROOM, "if Anchor is the anchor's id"),
    "half a unit": ("a.csv", "Anchor,X [cm],Y,Z\n" + rows("{id},{x},{y},{z}", scale=100), ROOM, "if all are in cm"),
}

PHOTO_NAMES = tuple(f"IMG_{k}.jpg" for k in range(6))
START_S = 1777888800.0  # 2026-05-04 10:00:00 UTC
PHOTO_TIMES = dict(zip(PHOTO_NAMES, (0.0, 0.5, 1.25, 2.0, 2.75, 4.5)))


def timed(text: str, *, scale: float = 1.0, start: float = 0.0, decimals: int = 3, comma: bool = False) -> str:
    """Return a line for each photo; the text has {name}, {stem}, {time} and, for civil times, {seconds}."""
    lines = []
    for name, time in PHOTO_TIMES.items():
        words = {"time": f"{scale * (time + start):.{decimals}f}", "seconds": f"{time:06.3f}"}
        words = {key: word.replace(".", ",") if comma else word for key, word in words.items()}
        lines.append(text.format(name=name, stem=name.removesuffix(".jpg"), **words))
    return "\n".join(lines) + "\n"


TIME_FILES: dict[str, tuple[str, str | bytes, str | None]] = {
    "canonical": ("images.csv", "image_name,timestamp_s\n" + timed("{name},{time}"), None),
    "English": ("times.csv", "image,time\n" + timed("{name},{time}"), None),
    "decimal commas": ("zeiten.csv", "Photo;Time [s]\n" + timed("{name};{time}", comma=True), None),
    "canonical names, decimal commas": (
        "images.csv",
        "image_name;timestamp_s\n" + timed("{name};{time}", comma=True),
        None,
    ),
    "German dates": (
        "fotos.csv",
        "Bild;Datum;Uhrzeit\n" + timed("{name};04.05.2026;10:00:{seconds}", comma=True),
        None,
    ),
    "French": ("photos.csv", "Fichier;Heure\n" + timed("{name};10:00:{seconds}", comma=True), None),
    "ISO 8601": ("t.txt", "Foto\tZeit\n" + timed("{name}\t2026-05-04T10:00:{seconds}Z"), None),
    "exiftool": (
        "meta.csv",
        "SourceFile,FileName,SubSecDateTimeOriginal,ISO\n"
        + timed("./DCIM/{name},{name},2026:05:04 10:00:{seconds},100"),
        None,
    ),
    "milliseconds": ("t.csv", "filename,time_ms\n" + timed("{name},{time}", scale=1e3, decimals=0), None),
    "nanoseconds of a data set": (
        "data.csv",
        "#timestamp [ns],filename\n" + timed("{time},{name}", scale=1e9, start=START_S, decimals=0),
        None,
    ),
    "a list of frames": (
        "rgb.txt",
        "# color images\n# timestamp filename\n" + timed("{time} rgb/{name}", start=START_S),
        None,
    ),
    "no names of columns": ("list.txt", timed("{name} {time}"), None),
    "no endings": ("times.csv", "photo,timestamp\n" + timed("{stem},{time}"), None),
    "paths of Windows": ("t.csv", "Image,Time\n" + timed("C:\\Users\\me\\DCIM\\{name},{time}"), None),
    "a time without a name": ("t.csv", "photo,x\n" + timed("{name},{time}"), "if photo is the photo"),
}


def survey_by_init(folder: Path, choice: str | None, capsys: pytest.CaptureFixture[str]) -> Survey:
    """Make a survey with nothing typed, or by the command that `init` gives for a choice."""
    status, command = main(["init", str(folder)]), None
    told = capsys.readouterr()
    if choice is not None:
        assert status == 2
        assert not (folder / "survey.toml").exists()
        (line,) = (line for line in told.err.splitlines() if line.strip().startswith(choice))
        command = shlex.split(line[line.index("rangesfm init") :])
        status = main(command[1:])
        told = capsys.readouterr()
    assert status == 0, told.err
    assert "missing" not in told.out
    assert "note: not used" not in told.out
    return read_survey(folder / "survey.toml")


def check_positions(anchors: Iterable[Anchor], places: dict[str, Place]) -> None:
    found = {anchor.anchor_id: anchor.position_m for anchor in anchors}
    assert [*found] == [*places]
    for name, place in places.items():
        np.testing.assert_allclose(np.array(found[name], np.float64), place, atol=1e-5)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    write_photos(folder, len(PHOTO_NAMES))
    return folder


def make_survey(folder: Path, photos: Path, name: str, content: str | bytes) -> Path:
    (folder / "DCIM").symlink_to(photos)
    write_log(folder / "uwb.csv", START_S)
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("kind", ANCHOR_FILES)
def test_an_anchor_file_is_read_with_nothing_typed_or_by_the_command_given(
    kind: str, tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, content, places, choice = ANCHOR_FILES[kind]
    path = make_survey(tmp_path, photos, name, content)
    survey = survey_by_init(tmp_path, choice, capsys)
    assert survey.anchors.path == path
    anchors = read_anchors(path, columns=survey.anchors.columns, unit=survey.anchors.unit)
    check_positions(anchors, places)


@pytest.mark.parametrize("kind", TIME_FILES)
def test_times_of_photos_are_read_with_nothing_typed_or_by_the_command_given(
    kind: str, tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, content, choice = TIME_FILES[kind]
    path = make_survey(tmp_path, photos, name, content)
    images = survey_by_init(tmp_path, choice, capsys).images
    assert images.times == path
    folder = tmp_path / "DCIM"
    times = find_image_times(
        folder, list_images(folder), images.times, columns=images.times_columns, unit=images.times_unit
    )
    assert times.image_names == PHOTO_NAMES
    np.testing.assert_allclose(np.diff(times.timestamps_s), np.diff([*PHOTO_TIMES.values()]), atol=1e-6)
    assert times.resolution_s == 0.001


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("anchors.csv", "Anchor,X,Y\nA1,1,2\nA2,3,4\n", "not sure: no column seems to be z (height)"),
        ("anchors.txt", "first 1 2\nsecond 3 4\n", "not sure: no column seems to be the anchor's id"),
        ("wgs.csv", "Point,Latitude,Longitude,Altitude\nA1,47.5,8.5,400\nA2,47.51,8.5,400\n", "degrees"),
        (
            "t.csv",
            "photo,timestamp\n" + "".join(f"IMG_{k}.jpg,{33 * k}\n" for k in range(25)),
            "not sure: the times have steps of 33",
        ),
    ],
)
def test_what_looks_like_a_list_and_is_not_understood_stops_init(
    name: str, content: str, reason: str, tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_survey(tmp_path, photos, name, content)
    assert main(["init", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert reason in told
    assert f"rangesfm init {tmp_path} --" in told
    assert not (tmp_path / "survey.toml").exists()


def test_a_list_that_is_not_understood_is_only_listed_beside_one_that_is(
    tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_survey(tmp_path, photos, "anchors.csv", ANCHOR_FILES["canonical"][1])
    (tmp_path / "raw.csv").write_text(rows("{id},{y},{x},{z},raw", LOCAL_GRID))
    assert main(["init", str(tmp_path)]) == 0
    assert (
        "note: not used: raw.csv (a table of anchors whose columns are not known for sure)" in capsys.readouterr().out
    )
    assert read_survey(tmp_path / "survey.toml").anchors.path == tmp_path / "anchors.csv"


def test_a_truncated_row_of_a_list_is_an_error_with_its_line(
    tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_survey(tmp_path, photos, "a.csv", "Point;East;North;Height\nA1;1;2;3\nA2;4;5\nA3;4;5;6\n")
    assert main(["init", str(tmp_path)]) == 0
    assert f"missing: {tmp_path / 'a.csv'}:3: has 3 cells, the header row has 4" in capsys.readouterr().out


def test_after_a_mended_file_init_is_done_again_and_a_changed_survey_file_is_kept(
    tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_survey(tmp_path, photos, "a.csv", "Point;East;North;Height\nA1;1;2;3\nA2;4;5;high\n")
    assert main(["init", str(tmp_path)]) == 0
    assert "Height is 'high', expected a number of metres" in capsys.readouterr().out
    path.write_text("Point;East;North;Height\n" + rows("{id};{x};{y};{z}"))
    assert main(["init", str(tmp_path)]) == 2
    assert "--force writes it anew" in capsys.readouterr().err
    assert main(["init", str(tmp_path), "--force"]) == 0
    assert "missing" not in capsys.readouterr().out
    written = tmp_path / "survey.toml"
    written.write_text(written.read_text() + "# mine\n")
    for kept in ("survey.toml.old", "survey.toml.old2"):
        mine = written.read_text()
        assert main(["init", str(tmp_path), "--force"]) == 0
        assert f"and kept the earlier one as {kept}" in capsys.readouterr().out
        assert (tmp_path / kept).read_text() == mine
        written.write_text("# changed again\n")


def test_photos_without_times_get_them_by_their_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photos(tmp_path / "frames", 12, has_times=False)
    write_log(tmp_path / "uwb.csv", 0.0)
    assert main(["init", str(tmp_path)]) == 0
    assert "or a fixed rate of the photos (--image_rate_hz)" in capsys.readouterr().out
    assert main(["init", str(tmp_path), "--force", "--image_rate_hz", "4"]) == 0
    told = capsys.readouterr().out
    assert "times: 12 keyframes from 0.000 to 2.750 s (rate)" in told
    images = read_survey(tmp_path / "survey.toml").images
    times = find_image_times(tmp_path / "frames", list_images(tmp_path / "frames"), rate_hz=images.rate_hz)
    assert times.image_names == tuple(f"IMG_{k}.jpg" for k in range(12))  # 2 before 10
    np.testing.assert_allclose(np.diff(times.timestamps_s), 0.25)


def test_units_of_anchors_that_do_not_fit_the_ranges_are_asked_for(
    tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = "Anchor,X,Y,Z\n" + rows("{id},{x},{y},{z}", scale=1e3, decimals=0)
    make_survey(tmp_path, photos, "a.csv", content)
    assert main(["init", str(tmp_path)]) == 0
    assert "are the positions in millimetres? expected metres, or their unit (--anchor_unit)" in capsys.readouterr().out
    assert main(["init", str(tmp_path), "--force", "--anchor_unit", "mm"]) == 0
    assert "missing" not in capsys.readouterr().out
    anchors = read_ranging_inputs(read_survey(tmp_path / "survey.toml")).anchors
    check_positions(anchors, ROOM)
