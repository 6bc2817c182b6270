"""Keys of the table [mapper] of a survey file. Those of all other tables are in ``options``."""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rangesfm.errors import OptionError
from rangesfm.option_model import Key, Options

# A key this similar to one of ours (difflib's ratio, 0 to 1) is a typing error; any other key is meant for pycolmap.
_LIKE_OURS = 0.85


class MapperOptions(Options, table="mapper"):
    """Mapping of the photos to an unscaled model by COLMAP. Other keys are passed to pycolmap as in pipeline."""

    method: Annotated[Literal["incremental", "global", "hierarchical", "external"], Key(flag="mapper_method")] = (
        "incremental"
    )
    """COLMAP's mapper, or another one. incremental: photo by photo; global: all photos at once; hierarchical: photo by
    photo in clusters, which are then merged; external: the program of command."""
    command: Annotated[str, Key(flag="mapper_command", metavar="COMMAND")] = ""
    """External mapper with its arguments, quoted as in a shell, but run without one. It is run in a folder with a copy
    of the database as database.db, and writes a COLMAP model to sparse/0. {images} stands for the folder of the
    photos."""
    matching: Literal["sequential", "exhaustive", "spatial", "vocabtree", "auto"] = "auto"
    """Pairs of photos that are matched. sequential: neighbours in time; exhaustive: all pairs; spatial: neighbours by
    EXIF position; vocabtree: photos that look alike; auto: exhaustive up to 60 keyframes, sequential above."""
    vocab_tree_path: Annotated[Path | None, Key(metavar="TREE", role="file")] = None
    """File with COLMAP's vocabulary tree, which finds photos that look alike. vocabtree matching needs it, and so does
    loop_detection with sequential matching; it is never downloaded."""
    pairs: Annotated[Path | None, Key(role="file")] = None
    """Text file with the names of two photos on each line, separated by a tab. Only these pairs are matched."""
    mask_path: Annotated[Path | None, Key(role="photos")] = None
    """Folder of masks. The mask of photo a/b.jpg is a/b.jpg.png, of the same size, black where features are not
    wanted."""
    database_path: Annotated[Path | None, Key(metavar="DB", role="file")] = None
    """COLMAP database, also one written by hloc. It is copied. Its features and matches are used, and its cameras too
    unless [camera] gives a model or params; what it lacks is computed. Photos that are not in it are left out."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device that computes features and matches. cuda: an NVIDIA GPU; auto: a GPU if pycolmap finds one."""
    features: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's FeatureExtractionOptions."""
    pairing: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's pairing options of the chosen matching."""
    matcher: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's FeatureMatchingOptions."""
    pipeline: dict[str, Any] = Field(default_factory=dict)
    """Passed through to the options of pycolmap's mapper: IncrementalPipelineOptions, GlobalPipelineOptions or
    HierarchicalPipelineOptions. Unlike COLMAP, the incremental mapper adjusts all of a growing map only when it has
    doubled, and once; when it is whole, it is adjusted to the end. ba_global_frames_ratio = 1.1 etc. change that."""
    close_loops: bool = True
    """Match photos of distant times that the refined map predicts to see the same, and refine again with these matches.
    Photos of different models that look alike are matched too. Without anything in metres (reconstruct), the unscaled
    model proposes, and photos that look alike are matched. Only where neighbours in time alone were matched, and with
    refine where database_path gives the matches."""
    num_threads: Annotated[
        Literal[-1] | Annotated[int, Field(ge=1, le=4096)],
        Key(expected="1 or more up to 4096, or -1 for all cores"),
    ] = -1
    """Number of threads; -1: one for each core. Matching on the processor runs this many processes with one thread
    each, because pycolmap 4.2 loses matches with several threads; matcher.num_threads sets the threads of a process."""
    reproducible: bool = False
    """Map in one thread, so that every run with the same seed gives the same bytes. With several threads, sums differ
    in their last digits from run to run, and the map may begin with another pair of photos."""

    @property
    def num_cores(self) -> int:
        """Return ``num_threads``, or the number of cores of this machine where it is -1."""
        return self.num_threads if self.num_threads > 0 else os.cpu_count() or 1

    @model_validator(mode="after")
    def _has_all_that_it_needs(self) -> MapperOptions:
        by_tree = self.matching == "vocabtree" or self.pairing.get("loop_detection") is True
        if by_tree and self.vocab_tree_path is None and "vocab_tree_path" not in self.pairing:
            message = "[mapper] vocab_tree_path is not given, expected COLMAP's vocabulary tree for this matching"
            raise OptionError(message, "mapper", "matching" if self.matching == "vocabtree" else "pairing")
        if (self.method == "external") != bool(self.command):
            where = "is not given" if not self.command else f"is given beside method {self.method}"
            raise self.refused("command", f"{where}, expected it with method external, and only there")
        if self.method == "external" and self.pipeline:
            raise self.refused("pipeline", "is given, expected none: an external mapper takes its options in command")
        if self.reproducible and self.pipeline.get("num_threads", 1) != 1:
            raise self.refused("pipeline", "sets num_threads, expected 1 or none with reproducible")
        if self.mask_path is not None and self.database_path is not None:
            why = "is given beside database_path, expected one of them: there are features already"
            raise self.refused("mask_path", why)
        return self

    @model_validator(mode="before")
    @classmethod
    def _others_to_pipeline(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Move unknown keys to ``pipeline``, for pycolmap to check, unless they resemble a key of this table."""
        known = list(cls.model_fields)
        others = {
            name: value for name, value in values.items() if not difflib.get_close_matches(name, known, 1, _LIKE_OURS)
        }
        ours = {name: value for name, value in values.items() if name not in others}
        if others and isinstance(pipeline := ours.get("pipeline", {}), dict):
            ours["pipeline"] = {**others, **pipeline}
        return ours
