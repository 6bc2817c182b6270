"""The keys of [mapper] in a survey file, as ``options`` has those of the other tables."""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rangesfm.errors import OptionError
from rangesfm.option_model import Options, Told

_LIKE_OURS = 0.85  # a key this similar to one of ours is a slip; others are pycolmap's


class MapperOptions(Options, table="mapper"):
    """Photos to unscaled model. Keys that are not here are of pycolmap's options of the mapper, as in pipeline."""

    method: Annotated[Literal["incremental", "global", "hierarchical"], Told(flag="mapper_method")] = "incremental"
    """COLMAP's mapper: photo by photo; all at once; photo by photo in clusters, which are merged."""
    matching: Literal["sequential", "exhaustive", "spatial", "vocabtree", "auto"] = "auto"
    """Which photos are matched: neighbours in time, all, neighbours by EXIF position, those that look alike; auto: all
    up to 60 keyframes, else neighbours in time."""
    vocab_tree_path: Annotated[Path | None, Told(metavar="TREE", role="file")] = None
    """COLMAP's vocabulary tree, by which photos look alike: for vocabtree matching, and for loop_detection of the
    pairing of neighbours in time; nothing is downloaded."""
    pairs: Annotated[Path | None, Told(role="file")] = None
    """Text file with the names of two photos a line, a tab between them: these pairs are matched, and no others."""
    mask_path: Annotated[Path | None, Told(role="photos")] = None
    """Folder of masks: for photo a/b.jpg the image a/b.jpg.png of the same size, black where no features are wanted."""
    database_path: Annotated[Path | None, Told(metavar="DB", role="file")] = None
    """Database of COLMAP's or hloc's, which is copied: its features, matches and (where [camera] says neither model nor
    params) cameras are used, and only what it lacks is computed; photos that it does not know are left out."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What computes features and matches: the processor, or a GPU by CUDA; auto: a GPU if pycolmap finds one."""
    features: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's FeatureExtractionOptions."""
    pairing: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's pairing options of the chosen matching."""
    matcher: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's FeatureMatchingOptions."""
    pipeline: dict[str, Any] = Field(default_factory=dict)
    """Passed through to pycolmap's IncrementalPipelineOptions; of the other mappers GlobalPipelineOptions and
    HierarchicalPipelineOptions."""
    ranges_in_mapping: bool = False
    """Each global bundle adjustment of the mapping carries the ranges, as soon as they determine the scale; takes much
    longer, and the refinement at the end mostly comes to the same map."""
    num_threads: Annotated[
        Literal[-1] | Annotated[int, Field(ge=1, le=4096)], Told(expected="1 or more up to 4096, or -1 for all cores")
    ] = -1
    """-1 for all cores. Matching on the processor takes so many processes with one thread each, as pycolmap 4.2 loses
    matches with more threads; matcher.num_threads overrides that one."""

    @property
    def num_cores(self) -> int:
        """What ``num_threads`` comes to here."""
        return self.num_threads if self.num_threads > 0 else os.cpu_count() or 1

    @model_validator(mode="after")
    def _has_all_that_it_needs(self) -> MapperOptions:
        by_tree = self.matching == "vocabtree" or self.pairing.get("loop_detection") is True
        if by_tree and self.vocab_tree_path is None and "vocab_tree_path" not in self.pairing:
            message = "[mapper] vocab_tree_path is not given, expected COLMAP's vocabulary tree for this matching"
            raise OptionError(message, "mapper", "matching" if self.matching == "vocabtree" else "pairing")
        if self.mask_path is not None and self.database_path is not None:
            why = "is given beside database_path, expected one of them: there are features already"
            raise self.refused("mask_path", why)
        return self

    @model_validator(mode="before")
    @classmethod
    def _others_to_pipeline(cls, values: dict[str, Any]) -> dict[str, Any]:
        """pycolmap knows best what its keys may be; only one much like ours is a slip."""
        known = list(cls.model_fields)
        others = {
            name: value for name, value in values.items() if not difflib.get_close_matches(name, known, 1, _LIKE_OURS)
        }
        ours = {name: value for name, value in values.items() if name not in others}
        if others and isinstance(pipeline := ours.get("pipeline", {}), dict):
            ours["pipeline"] = {**others, **pipeline}
        return ours
