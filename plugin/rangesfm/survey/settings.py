"""Survey: everything a run needs to know, from a TOML file, from flags or from both."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from rangesfm.errors import InputError, OptionError
from rangesfm.files.atomic import path_of
from rangesfm.options import (
    ANCHOR_FRAMES,
    CAMERA_SIDES,
    EXPORT_FRAMES,
    MATCHING_METHODS,
    SCALE_METHODS,
    STAMP_UNITS,
    AssociationOptions,
    CameraOptions,
    CheckOptions,
    ExportOptions,
    KeyframeOptions,
    MapperOptions,
    RangeModelOptions,
    RefineOptions,
    ScaleOptions,
)
from rangesfm.ranging.readers.time_units import SECONDS_PER_UNIT
from rangesfm.ranging.twr import AIR_M_PER_S, DW1000_TICK_S, VACUUM_M_PER_S, StampOptions
from rangesfm.survey.strict_tables import Rule, Source, StrictTable, parse_toml

TABLES = ("images", "camera", "ranges", "anchors", "tag", "mapper", "scale", "refine", "export", "report", "output")
_LIKE_OURS = 0.85  # a [mapper] key this similar to one of ours is a slip; others are pycolmap's

# An override of the first takes the place of the others in the file.
_INSTEAD_OF = {"tag.tag_in_cam_m": ("lever_arms_m",), "tag.lever_arms_m": ("tag_in_cam_m",)}

_MORE_THAN_0 = Rule("more than 0", lambda value: value > 0)
_FROM_0 = Rule("0 or more", lambda value: value >= 0)
_FROM_1 = Rule("1 or more", lambda value: value >= 1)
_FROM_3 = Rule("3 or more", lambda value: value >= 3)
_FROM_10 = Rule("10 or more", lambda value: value >= 10)


def _one_of(choices: tuple[str, ...]) -> Rule:
    return Rule("one of " + ", ".join(choices), lambda value: value in choices)


_RULES = {
    "every_nth": _FROM_1,
    "min_interval_s": _FROM_0,
    "max_num_keyframes": _FROM_1,
    "max_interpolation_gap_s": _FROM_0,
    "max_time_difference_s": _FROM_0,
    "check_share": Rule("from 0 to 0.5", lambda value: 0 <= value <= 0.5),
    "check_times_s": Rule("two times, the later one last", lambda value: len(value) == 2 and value[0] < value[1]),
    "range_stddev_m": _MORE_THAN_0,
    "range_bias_stddev_m": _FROM_0,
    "common_bias_stddev_m": _FROM_0,
    "max_relative_stddev": _MORE_THAN_0,
    "ranging_interval_s": _MORE_THAN_0,
    "stamp_unit": _one_of(STAMP_UNITS),
    "stamp_bits": Rule("32 or 40", lambda value: value in (32, 40)),
    "separator": Rule("one character", lambda value: len(value) == 1),
    "matching": _one_of(MATCHING_METHODS),
    "num_threads": Rule("1 or more, or -1 for all cores", lambda value: value == -1 or value >= 1),
    "submap_size": _FROM_10,
    "submap_overlap": _FROM_3,
    "num_submaps_at_once": _FROM_1,
    "method": _one_of(SCALE_METHODS),
    "camera_side": _one_of(CAMERA_SIDES),
    "up_in_first_camera": Rule("a direction, not 0,0,0", lambda value: any(value)),
    "num_bootstrap": _FROM_0,
    "bootstrap_block_s": _MORE_THAN_0,
    "max_num_iterations": _FROM_0,
    "range_loss_scale": _MORE_THAN_0,
    "lever_arm_stddev_m": _FROM_0,
    "time_offset_stddev_s": _FROM_0,
    "short_range_stddev_m": _FROM_0,
    "seed": _FROM_0,
}
# Where one name means different things.
_RULES_OF = {"anchors": {"frame": _one_of(ANCHOR_FRAMES)}, "export": {"frame": _one_of(EXPORT_FRAMES)}}


@dataclass(frozen=True)
class RangesConfig:
    """The radio's log and how to take it (table ``[ranges]``).

    Attributes:
        path: the log; None if not given.
        format: name of a reader; None: recognised by content.
        columns, timestamp_unit, range_unit, separator, ranging_interval_s: as in ``read_ranges``.
        stamps: how time stamps of two-way ranging become ranges.
        error_curve_path: the radio's error by distance, as ``rangesfm ranges calibrate`` writes it; None: not known.
        time_offset_s: image time = range time + offset; None: searched for ("auto").
        association: where ranges are put on the path.
        checks: which ranges are held out.
        model: what is assumed of the radio.
    """

    path: Path | None = None
    format: str | None = None
    columns: dict[str, str] = field(default_factory=dict)
    timestamp_unit: str | None = None
    range_unit: str | None = None
    separator: str | None = None
    ranging_interval_s: float | None = None
    stamps: StampOptions = field(default_factory=StampOptions)
    error_curve_path: Path | None = None
    time_offset_s: float | None = None
    association: AssociationOptions = field(default_factory=AssociationOptions)
    checks: CheckOptions = field(default_factory=CheckOptions)
    model: RangeModelOptions = field(default_factory=RangeModelOptions)


@dataclass(frozen=True)
class Survey:
    """Inputs, options and output of one run. Paths are absolute.

    Attributes:
        images_path: folder of the photos.
        model_path: an existing COLMAP model, for those who start from one; not a key of the file.
        image_times_path: CSV of image times; None: EXIF, else file names.
        anchors_path: None: the anchors in the log, all unknown.
        anchor_frame: one of ANCHOR_FRAMES; None: "site" if the file knows any position, else "unknown".
        anchor_crs: coordinate system of their positions, as "EPSG:2056"; None: metres of a frame of their own.
        use_anchors: ids of the anchors whose ranges are used; empty: all.
        tag_in_cam_m: lever arm: the tag's antenna in the camera frame, metres.
        lever_arms_m: the same by tag id, for a camera with several tags; empty: there is only one.
        tag_id: which tag of the log counts; None: all that have a lever arm.
        distances_path, markers_path: taped distances, and the marks in photos between which they were taken.
        reference_path: true positions, for comparison.
        export: what to write beside the COLMAP models, and in which frame.
        output_path: folder of the results.
        seed: of everything random.
        source: the survey file, for messages; no setting.
    """

    images_path: Path | None = None
    model_path: Path | None = None
    image_times_path: Path | None = None
    keyframes: KeyframeOptions = field(default_factory=KeyframeOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    ranges: RangesConfig = field(default_factory=RangesConfig)
    anchors_path: Path | None = None
    anchor_frame: str | None = None
    anchor_crs: str | None = None
    use_anchors: tuple[str, ...] = ()
    tag_in_cam_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_arms_m: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    tag_id: str | None = None
    mapper: MapperOptions = field(default_factory=MapperOptions)
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    refine: RefineOptions = field(default_factory=RefineOptions)
    distances_path: Path | None = None
    markers_path: Path | None = None
    reference_path: Path | None = None
    export: ExportOptions = field(default_factory=ExportOptions)
    report_enabled: bool = True
    output_path: Path = Path("out")
    seed: int = 0
    source: Source = field(default_factory=Source, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, fit for JSON."""
        plain: dict[str, Any] = _plain(asdict(replace(self, source=Source())))
        del plain["source"]
        return plain

    @contextmanager
    def naming_its_lines(self) -> Iterator[None]:
        """Say in which line of the survey file an option stands that a stage finds wrong."""
        try:
            yield
        except OptionError as error:
            # Keys of [mapper] that are not ours are the pipeline's.
            tables = (error.table, error.table.replace("mapper.pipeline", "mapper"))
            found = [self.source.error(str(error), table, error.key) for table in tables]
            raise next((named for named in found if named.line is not None), found[0]) from None


def read_survey(
    path: str | Path, overrides: Mapping[str, object] | None = None, base_folder: str | Path | None = None
) -> Survey:
    """Read a survey file.

    Args:
        path: the TOML file.
        base_folder: what relative paths in the file refer to; None: the file's own folder.
        overrides: values by dotted key (``{"ranges.path": "uwb.csv"}``) that replace those of the file;
            their paths are relative to the working directory.

    Raises:
        InputError: with the line where possible, for an unknown table or key, a value of the wrong
            type or out of bounds, and a file that does not exist.
    """
    tables, source = parse_toml(Path(path))
    folder = Path(path).absolute().parent if base_folder is None else Path(base_folder).absolute()
    return _survey(tables, folder, overrides or {}, source)


def survey_from_tables(
    tables: Mapping[str, Any], base_folder: str | Path, overrides: Mapping[str, object] | None = None
) -> Survey:
    """The same from tables in memory, with paths relative to ``base_folder``."""
    return _survey(tables, Path(base_folder).absolute(), overrides or {}, Source())


def _survey(tables: Mapping[str, Any], folder: Path, overrides: Mapping[str, object], source: Source) -> Survey:
    reader = _SurveyReader(tables, folder, overrides, source)
    survey = Survey(
        **reader.images(),
        **reader.anchors(),
        **reader.tag(),
        **reader.tape(),
        **reader.report(),
        **reader.output(),
        camera=reader.table("camera").options(CameraOptions),
        ranges=reader.ranges(),
        mapper=reader.mapper(),
        scale=reader.table("scale").options(ScaleOptions),
        refine=reader.table("refine").options(RefineOptions),
        export=reader.table("export").options(ExportOptions),
    )
    reader.refuse_unknown()
    return replace(survey, source=source)


class _SurveyReader:
    """The tables of a survey, each turned into its part of the Survey."""

    def __init__(self, tables: Mapping[str, Any], folder: Path, overrides: Mapping[str, object], source: Source):
        source = replace(source, overridden=frozenset(overrides))
        self._root = StrictTable(_merged(tables, overrides), "", source)
        self._source = source
        self._folder = folder
        self._tables = {
            name: StrictTable(self._root.value(name, Any, {}), name, source, {**_RULES, **_RULES_OF.get(name, {})})
            for name in TABLES
        }

    def table(self, name: str) -> StrictTable:
        return self._tables[name]

    def refuse_unknown(self) -> None:
        self._root.refuse_unknown()
        for table in self._tables.values():
            table.refuse_unknown()

    def images(self) -> dict[str, Any]:
        return {
            "images_path": self._path("images", "path", must_exist=False),
            "image_times_path": self._path("images", "times"),
            "keyframes": self.table("images").options(KeyframeOptions),
        }

    def ranges(self) -> RangesConfig:
        table = self.table("ranges")
        return RangesConfig(
            path=self._path("ranges", "path"),
            format=table.value("format", str),
            columns=table.value("columns", dict[str, str], {}),
            timestamp_unit=table.value("timestamp_unit", str),
            range_unit=table.value("range_unit", str),
            separator=table.value("separator", str),
            ranging_interval_s=table.value("ranging_interval_s", float),
            stamps=_stamps(table),
            error_curve_path=self._path("ranges", "error_curve"),
            time_offset_s=_time_offset(table),
            association=table.options(AssociationOptions),
            checks=table.options(CheckOptions),
            model=table.options(RangeModelOptions),
        )

    def anchors(self) -> dict[str, Any]:
        return {
            "anchors_path": self._path("anchors", "path"),
            "anchor_frame": self.table("anchors").value("frame", str),
            "anchor_crs": self.table("anchors").value("crs", str),
            "use_anchors": self.table("anchors").value("use", tuple[str, ...], ()),
        }

    def tag(self) -> dict[str, Any]:
        table = self.table("tag")
        tag_in_cam_m = table.value("tag_in_cam_m", tuple[float, float, float])
        lever_arms_m = table.value("lever_arms_m", dict[str, tuple[float, float, float]], {})
        if tag_in_cam_m is not None and lever_arms_m:
            raise table.error("tag_in_cam_m", "nothing beside lever_arms_m: either one lever arm or one by tag id")
        return {
            "tag_in_cam_m": tag_in_cam_m or (0.0, 0.0, 0.0),
            "lever_arms_m": lever_arms_m,
            "tag_id": table.value("tag_id", str),
        }

    def tape(self) -> dict[str, Any]:
        distances_path, markers_path = self._path("scale", "distances"), self._path("scale", "markers")
        if markers_path is not None and distances_path is None:
            raise self.table("scale").error(
                "markers", "distances beside it: marks are only the ends of taped distances"
            )
        return {"distances_path": distances_path, "markers_path": markers_path}

    def mapper(self) -> MapperOptions:
        """Keys that are not ours belong to pycolmap's pipeline options, which know best what they may be."""
        table = self.table("mapper")
        options = table.options(MapperOptions)
        table.refuse_unknown(min_likeness=_LIKE_OURS)
        return replace(options, pipeline={**table.rest(), **options.pipeline})

    def report(self) -> dict[str, Any]:
        return {
            "reference_path": self._path("report", "reference"),
            "report_enabled": self.table("report").value("enabled", bool, True),
        }

    def output(self) -> dict[str, Any]:
        path = self._path("output", "path", must_exist=False) or self._folder / "out"
        return {"output_path": path, "seed": self.table("output").value("seed", int, 0)}

    def _path(self, table_name: str, key: str, *, must_exist: bool = True) -> Path | None:
        table = self.table(table_name)
        text: str | None = table.value(key, str)
        if text is None:
            return None
        if not text:
            raise table.error(key, "a path")
        folder = Path.cwd() if f"{table_name}.{key}" in self._source.overridden else self._folder
        path = folder / path_of(text)
        if must_exist and not os.path.isfile(path):
            found = f"{path} is a folder, expected a file" if os.path.isdir(path) else f"there is no file {path}"
            raise self._source.error(f"[{table_name}] {key}: {found}", table_name, key)
        return path


def _stamps(table: StrictTable) -> StampOptions:
    """Keys stamp_unit, stamp_bits, propagation_speed ("air", "vacuum" or m/s) and t_off_s."""
    unit = table.value("stamp_unit", str, "ns")
    return StampOptions(
        unit_s=DW1000_TICK_S if unit == "ticks" else SECONDS_PER_UNIT[unit],
        wrap_s=2 ** table.value("stamp_bits", int, 32) * DW1000_TICK_S,
        propagation_speed_m_per_s=_propagation_speed(table),
        t_off_s=table.value("t_off_s", float, 0.0),
    )


def _propagation_speed(table: StrictTable) -> float:
    key = "propagation_speed"
    speed = table.value(key, Any, "air")
    if speed in ("air", "vacuum"):
        return {"air": AIR_M_PER_S, "vacuum": VACUUM_M_PER_S}[speed]
    if not isinstance(speed, (int, float)) or not 1e8 < speed < 3e8:
        raise table.error(key, "air, vacuum or a speed of light in m/s")
    return float(speed)


def _time_offset(table: StrictTable) -> float | None:
    key = "time_offset"
    offset = table.value(key, Any, "auto")
    if offset == "auto":
        return None
    try:
        return float(table.value(key, float))
    except InputError:
        raise table.error(key, '"auto" or seconds') from None


def _merged(tables: Mapping[str, Any], overrides: Mapping[str, object]) -> dict[str, Any]:
    merged = {name: dict(table) if isinstance(table, Mapping) else table for name, table in tables.items()}
    for dotted_key, value in overrides.items():
        table_name, _, key = dotted_key.partition(".")
        table = merged.setdefault(table_name, {})
        if isinstance(table, dict):
            for other in _INSTEAD_OF.get(dotted_key, ()):
                table.pop(other, None)
            table[key] = str(value) if isinstance(value, Path) else value
    return merged


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)
