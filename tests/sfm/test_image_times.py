from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rangesfm.errors import InputError
from rangesfm.sfm.image_times import (
    find_image_times,
    list_images,
    read_image_times_csv,
)

NEW_YEAR_2026_S = 1767225600.0


def write_photo(path: Path, taken: str | None = None, subsec: str | None = None, offset: str | None = None) -> None:
    exif = Image.Exif()
    tags = {0x9003: taken, 0x9291: subsec, 0x9011: offset}
    exif.get_ifd(0x8769).update({tag: value for tag, value in tags.items() if value is not None})
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 6)).save(path, exif=exif)


def write_photos(folder: Path, *names: str) -> None:
    for name in names:
        write_photo(folder / name)


def write_csv(folder: Path, text: str) -> Path:
    path = folder / "images.csv"
    path.write_text(text)
    return path


class TestListImages:
    def test_finds_photos_of_all_kinds_in_subfolders_sorted(self, tmp_path: Path) -> None:
        for name in ("b.JPG", "a.jpeg", "left/c.png", "left/deep/d.TIFF", "e.webp", "f.bmp"):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).touch()
        assert list_images(tmp_path) == ("a.jpeg", "b.JPG", "e.webp", "f.bmp", "left/c.png", "left/deep/d.TIFF")

    def test_leaves_out_hidden_files_and_other_files(self, tmp_path: Path) -> None:
        (tmp_path / ".thumbnails").mkdir()
        for name in ("a.png", "._a.png", ".thumbnails/b.png", "notes.txt", "video.mp4"):
            (tmp_path / name).touch()
        assert list_images(tmp_path) == ("a.png",)

    def test_says_that_there_is_no_such_folder(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"photos: no such folder"):
            list_images(tmp_path / "photos")

    def test_says_that_a_file_is_no_folder(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"images.csv: is a file, expected a folder"):
            list_images(write_csv(tmp_path, ""))

    def test_finds_photos_of_several_folders_behind_links_once(self, tmp_path: Path) -> None:
        write_photos(tmp_path / "disk", "a.png")
        write_photos(tmp_path / "card", "a.png")
        (tmp_path / "all").mkdir()
        (tmp_path / "all" / "left").symlink_to(tmp_path / "disk")
        (tmp_path / "all" / "right").symlink_to(tmp_path / "card")
        (tmp_path / "disk" / "again").symlink_to(tmp_path / "all")
        assert list_images(tmp_path / "all") == ("left/a.png", "right/a.png")

    def test_says_that_a_folder_has_no_photos(self, tmp_path: Path) -> None:
        (tmp_path / "a.txt").touch()
        with pytest.raises(InputError, match=r"no photos \(jpg jpeg png tif tiff bmp webp\) in this folder$"):
            list_images(tmp_path)
        (tmp_path / "IMG_7.HEIC").touch()
        with pytest.raises(InputError, match=r"in this folder; convert IMG_7.HEIC and its like to JPEG$"):
            list_images(tmp_path)


class TestCsv:
    def test_gives_photos_in_time_order_whatever_the_order_of_lines(self, tmp_path: Path) -> None:
        times = read_image_times_csv(write_csv(tmp_path, "image_name,timestamp_s\nb.jpg,2.5\nc.jpg,3.125\na.jpg,7\n"))
        assert times.image_names == ("b.jpg", "c.jpg", "a.jpg")
        assert np.array_equal(times.timestamps_s, [2.5, 3.125, 7.0])
        assert (times.source, times.resolution_s, times.notes) == ("csv", 0.001, ())
        assert times.by_name() == {"b.jpg": 2.5, "c.jpg": 3.125, "a.jpg": 7.0}

    def test_takes_columns_in_any_order_comments_blank_lines_and_other_names(self, tmp_path: Path) -> None:
        text = "# made by hand\n\ntimestamp,exposure,filename\n1.5,0.01,a.jpg\n# a pause\n\n2.5,0.01,b.jpg\n"
        assert read_image_times_csv(write_csv(tmp_path, text)).by_name() == {"a.jpg": 1.5, "b.jpg": 2.5}

    def test_leaves_out_photos_without_a_line_and_says_how_many(self, tmp_path: Path) -> None:
        path = write_csv(tmp_path, "image_name,timestamp_s\nb.jpg,2.5\n")
        times = read_image_times_csv(path, ["a.jpg", "b.jpg", "c.jpg"])
        assert times.image_names == ("b.jpg",)
        assert times.num_left_out == 2
        assert times.notes == ("2 of 3 photos have no time and are left out, the first is a.jpg",)

    def test_whole_seconds_are_said_to_be_coarse(self, tmp_path: Path) -> None:
        times = read_image_times_csv(write_csv(tmp_path, "image_name,timestamp_s\na.jpg,1000\nb.jpg,1001\n"))
        assert times.resolution_s == 1.0
        assert "whole seconds" in times.notes[0]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "images.csv: the file is empty"),
            ("image_name,timestamp_s\n", "images.csv: no rows below the header"),
            ("image_name,size_px\na.jpg,1\n", "no columns of photo times; found image_name, size_px"),
            (
                "image_name,timestamp_s\na.jpg,noon\n",
                "images.csv:2: timestamp_s is 'noon', expected a time in s",
            ),
            (
                "image_name,timestamp_s\na.jpg,1\n\nb.jpg,nan\n",
                "images.csv:4: timestamp_s is nan, expected a time in s",
            ),
            ("image_name,timestamp_s\na.jpg,\n", "images.csv:2: timestamp_s is empty, expected a time in s"),
            ("image_name,timestamp_s\n,1\n", "images.csv:2: image_name is empty"),
            ("image_name,timestamp_s\na.jpg,1.4e18\n", "images.csv:2: timestamp_s is 1.4e18, expected a time in s"),
            ("image_name,timestamp_s\na.jpg,1\na.jpg,2\n", "images.csv:3: a.jpg is in line 2 already"),
            (
                "image_name,timestamp_s\na.jpg,1\nb.jpg,1.0\n",
                "images.csv:3: b.jpg has the same time as a.jpg in line 2",
            ),
        ],
    )
    def test_names_the_line_of_what_is_wrong(self, tmp_path: Path, text: str, message: str) -> None:
        with pytest.raises(InputError) as error:
            read_image_times_csv(write_csv(tmp_path, text))
        assert message in str(error.value)

    def test_names_the_line_of_a_photo_that_does_not_exist(self, tmp_path: Path) -> None:
        path = write_csv(tmp_path, "image_name,timestamp_s\na.jpg,1\nz.jpg,2\n")
        with pytest.raises(InputError, match=r"images.csv:3: image_name is 'z.jpg', expected the name of a photo"):
            read_image_times_csv(path, ["a.jpg", "b.jpg"])

    def test_leaves_out_photos_that_were_taken_away(self, tmp_path: Path) -> None:
        path = write_csv(tmp_path, "image_name,timestamp_s\na.jpg,1.5\nz.jpg,2.5\nb.jpg,3.5\n")
        times = read_image_times_csv(path, ["a.jpg", "b.jpg"])
        assert (times.image_names, times.timestamps_s.tolist()) == (("a.jpg", "b.jpg"), [1.5, 3.5])
        assert times.notes == ("1 of the 3 names in images.csv belong to no photo in the folder",)


class TestExif:
    def test_reads_the_fraction_as_decimals_and_the_zone(self, tmp_path: Path) -> None:
        write_photo(tmp_path / "a.jpg", "2026:01:01 02:00:00", "05", "+02:00")
        write_photo(tmp_path / "b.jpg", "2025:12:31 19:00:01", "125", "-05:00")
        times = find_image_times(tmp_path, ["b.jpg", "a.jpg"])
        assert times.image_names == ("a.jpg", "b.jpg")
        assert np.allclose(times.timestamps_s - NEW_YEAR_2026_S, [0.05, 1.125], rtol=0, atol=1e-6)
        assert (times.source, times.resolution_s, times.notes) == ("exif", 0.001, ())

    def test_without_a_zone_the_clock_is_taken_for_utc_and_whole_seconds_are_noted(self, tmp_path: Path) -> None:
        write_photo(tmp_path / "a.jpg", "2026:01:01 00:00:00")
        write_photo(tmp_path / "b.jpg", "2026:01:01 00:00:02")
        times = find_image_times(tmp_path, ["a.jpg", "b.jpg"])
        assert np.array_equal(times.timestamps_s - NEW_YEAR_2026_S, [0.0, 2.0])
        assert times.resolution_s == 1.0
        assert "whole seconds" in times.notes[0]

    def test_a_photo_without_a_zone_has_that_of_the_others(self, tmp_path: Path) -> None:
        write_photo(tmp_path / "a.jpg", "2026:01:01 01:00:00", offset="+01:00")
        write_photo(tmp_path / "b.jpg", "2026:01:01 01:00:02")
        assert find_image_times(tmp_path, ["a.jpg", "b.jpg"]).timestamps_s[1] == NEW_YEAR_2026_S + 2

    def test_leaves_out_photos_without_time_and_those_of_a_second_that_has_one(self, tmp_path: Path) -> None:
        for name in ("a.jpg", "b.jpg"):
            write_photo(tmp_path / name, "2026:01:01 00:00:00")
        write_photo(tmp_path / "c.jpg", "2026:01:01 00:00:01")
        write_photo(tmp_path / "d.jpg", "0000:00:00 00:00:00")
        (tmp_path / "e.jpg").write_bytes(b"no photo")
        times = find_image_times(tmp_path, ["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"])
        assert times.image_names == ("a.jpg", "c.jpg")
        assert times.num_left_out == 3
        assert times.notes[:2] == (
            "2 of 5 photos have no time and are left out, the first is d.jpg",
            "1 of 5 photos have the same time as another and are left out, the first is b.jpg",
        )

    def test_names_the_file_of_a_rig_where_photos_of_several_folders_have_one_time(self, tmp_path: Path) -> None:
        names = [f"{camera}/{k}.jpg" for camera in ("left", "right") for k in range(2)]
        for name in names:
            write_photo(tmp_path / name, f"2026:01:01 00:00:0{name[-5]}")
        (note,) = find_image_times(tmp_path, names).notes[:1]
        assert note.endswith("are left out, the first is right/0.jpg (cameras of a rig need --rig_config_path)")


class TestFileNames:
    @pytest.mark.parametrize(
        ("names", "seconds", "resolution_s"),
        [
            (("cam0/1403715273262142976.png", "cam0/1403715273312143104.png"), (1403715273.262143, 0.050000128), 0.001),
            (("1403715273262142.png", "1403715273312142.png"), (1403715273.262142, 0.05), 0.001),
            (("f_1403715273262.png", "f_1403715273312.png"), (1403715273.262, 0.05), 0.001),
            (("1305032180.405639.png", "1305032180.437988.png"), (1305032180.405639, 0.032349), 0.001),
            (("rgb-12.500.png", "rgb-13.750.png"), (12.5, 1.25), 0.001),
            (("1403715273.png", "1403715275.png"), (1403715273.0, 2.0), 1.0),
        ],
        ids=["ns", "us", "ms", "decimal seconds", "seconds since some start", "whole seconds"],
    )
    def test_are_times_in_the_unit_that_their_size_says(
        self, names: tuple[str, str], seconds: tuple[float, float], resolution_s: float
    ) -> None:
        times = find_image_times("nowhere", names)
        assert times.image_names == names
        assert times.timestamps_s[0] == pytest.approx(seconds[0], abs=1e-6)
        assert times.timestamps_s[1] - times.timestamps_s[0] == pytest.approx(seconds[1], abs=1e-6)
        assert (times.source, times.resolution_s) == ("file_names", resolution_s)

    @pytest.mark.parametrize(
        "names",
        [
            ("image00000010.jpg", "image00000020.jpg"),
            ("DSC_0001.JPG", "DSC_0002.JPG"),
            ("IMG_20260131_101530.jpg", "IMG_20260131_101531.jpg"),
            ("20260131101530.jpg", "20260131101531.jpg"),
            ("scan_1.2.png", "scan_1.3.png"),
            ("kitchen.jpg", "hall.jpg"),
        ],
    )
    def test_frame_numbers_and_dates_are_not_taken_for_times(self, names: tuple[str, str]) -> None:
        with pytest.raises(InputError, match=f"no time for {names[0]}: expected a CSV file"):
            find_image_times("nowhere", names)


class TestFindImageTimes:
    def test_prefers_the_csv_file_to_exif_and_exif_to_names(self, tmp_path: Path) -> None:
        names = ("1403715273000.jpg", "1403715274000.jpg")
        write_photos(tmp_path, *names)
        assert find_image_times(tmp_path, names).source == "file_names"
        for second, name in enumerate(names):
            write_photo(tmp_path / name, f"2026:01:01 00:00:0{second}")
        assert find_image_times(tmp_path, names).source == "exif"
        path = write_csv(tmp_path, f"image_name,timestamp_s\n{names[0]},1.5\n")
        assert find_image_times(tmp_path, names, path).source == "csv"

    def test_names_the_first_photo_and_the_three_ways_when_there_is_none(self, tmp_path: Path) -> None:
        write_photos(tmp_path, "a.jpg", "b.jpg")
        with pytest.raises(InputError, match=r"no time for a.jpg: .*image_name,timestamp_s.*EXIF.*file names"):
            find_image_times(tmp_path, ("a.jpg", "b.jpg"))
