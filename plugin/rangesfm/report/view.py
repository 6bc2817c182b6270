"""The 3-D view's place on the page: canvas, controls, and the panel of the chosen photo."""

from __future__ import annotations

from rangesfm.ranging.observations import RangeStatus
from rangesfm.report.markup import Child, Markup, element
from rangesfm.report.packing import data_block
from rangesfm.report.scene import Scene, num_points_drawn, range_stride, scene_data
from rangesfm.report.text import count

SHOWN_STATUSES = (RangeStatus.USED.label, RangeStatus.DOWN_WEIGHTED.label)
NO_WEBGL = (
    "This browser cannot draw the 3-D view: WebGL is switched off or missing. Everything else on this page works."
)


def view(scene: Scene) -> Markup:
    """The view with its data."""
    data = scene_data(scene)
    return element(
        "div",
        element("p", NO_WEBGL, class_="without-webgl"),
        element("noscript", element("p", "The 3-D view needs JavaScript. Everything else on this page does not.")),
        element("div", _layers(scene), _ranges(data["ranges"]), _tools(), class_="view-controls"),
        _stage(scene),
        _photo(scene, has_ranges=data["ranges"] is not None),
        element("p", _note(scene, num_thumbnails=len(data["thumbnails"])), class_="small"),
        data_block("scene", data),
        id="view",
    )


def _stage(scene: Scene) -> Markup:
    return element(
        "div",
        element("canvas", tabindex="0", role="img", aria_label="The map, the cameras and the anchors in 3-D"),
        element("div", class_="labels", aria_hidden="true"),
        element("span", class_="scale-bar"),
        element("span", class_="grid-cell"),
        element("img", class_="printed", alt="The map, the cameras and the anchors in 3-D"),
        class_="stage",
    )


def _layers(scene: Scene) -> Markup:
    layers = [("points", "Map points", "map-point")] if len(scene.points_m) else []
    layers += [(path.id, path.name, path.color) for path in scene.paths]
    layers += [("anchors", "Anchors", "anchor")] if scene.anchors else []
    layers += [("grid", "Grid", "grid")]
    boxes = [_checkbox("layer", id_, name, swatch=swatch) for id_, name, swatch in layers]
    return _group("Show", boxes)


def _ranges(ranges: dict[str, object] | None) -> Markup | None:
    if ranges is None:
        return None
    statuses = ranges["statuses"]
    assert isinstance(statuses, list)
    boxes: list[Child] = [
        _checkbox("status", str(i), name, is_checked=name in SHOWN_STATUSES) for i, name in enumerate(statuses)
    ]
    limit = f"{ranges['residual_limit_m']:.2f} m"
    legend = element(
        "span",
        f"−{limit}",
        element("i", class_="residual-scale"),
        f"+{limit}",
        class_="residual-legend",
        title="predicted minus measured",
    )
    everywhere = _checkbox("all-photos", "all", "of all photos", is_checked=False)
    return _group("Ranges by status", boxes, everywhere, legend, element("span", class_="num-lines"))


def _tools() -> Markup:
    looks = [
        element("button", name, type="button", data_look=look)
        for look, name in (("oblique", "Oblique"), ("plan", "Plan"), ("elevation", "Elevation"))
    ]
    measured = element("output", class_="measured")
    return _group("View", looks, _checkbox("measure", "on", "Measure", is_checked=False), measured)


def _photo(scene: Scene, *, has_ranges: bool) -> Markup | None:
    if not scene.paths[-1].has_orientations:
        return None
    last = len(scene.result) - 1
    slider = element(
        "label",
        element("span", "Photo along the path"),
        element("input", type="range", name="photo", min="0", max=str(last), value="0", step="1"),
        class_="slider",
    )
    header = [element("th", name, scope="col") for name in ("anchor", "range m", "residual m", "status")]
    table = element("table", element("thead", element("tr", header)), element("tbody"))
    thumbnail = element(
        "div", element("img", alt=""), element("p", "No picture of this photo here.", class_="small no-thumbnail")
    )
    num_ranges = element("p", class_="num-ranges small") if has_ranges else None
    text = element("div", element("h3"), element("p", class_="place"), num_ranges)
    ranges = element("div", table, class_="scroll photo-ranges", tabindex="0") if has_ranges else None
    return element("div", slider, element("div", thumbnail, text, ranges, class_="photo", aria_live="polite"))


def _note(scene: Scene, *, num_thumbnails: int) -> list[str]:
    sentences = [
        "Drag to turn, wheel or pinch to zoom, right drag or two fingers to move; click a camera for its photo."
    ]
    if num_left_out := len(scene.points_m) - num_points_drawn(scene):
        sentences.append(f"{count(num_left_out)} points far away or beyond the view's limit are not drawn.")
    if scene.ranges is not None and (stride := range_stride(scene.ranges)) > 1:
        sentences.append(f"One in {stride} ranges is drawn and listed; ranges.csv holds all.")
    if 0 < num_thumbnails < (num_photos := len(scene.result)):
        sentences.append(f"{count(num_thumbnails)} of {count(num_photos)} photos have a picture: the page stays small.")
    if scene.anchors:
        sentences.append("Ellipsoids around the anchors hold 95 %, at their true size.")
    return [" ".join(sentences)]


def _group(name: str, *parts: Child) -> Markup:
    return element("fieldset", element("legend", name), parts)


def _checkbox(name: str, value: str, text: str, *, is_checked: bool = True, swatch: str | None = None) -> Markup:
    box = element("input", type="checkbox", name=name, value=value, checked="" if is_checked else None)
    return element("label", box, element("i", class_=f"swatch {swatch}") if swatch else None, text)
