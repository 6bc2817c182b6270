// Ranges as lines from the radio at the camera to its anchor, coloured by residual.

const RESIDUAL_STOPS = ["residual-negative", "residual-zero", "residual-positive"];

/** Colour of a residual in the scale from -limit to +limit, as three bytes. */
function residualColor(residual, limit, stops) {
  const place = Math.max(-1, Math.min(1, residual / limit));
  const end = place < 0 ? stops[0] : stops[2];
  const share = Math.sqrt(Math.abs(place));
  return stops[1].map((value, channel) => Math.round(value + share * (end[channel] - value)));
}

/** "#rrggbb" as three bytes. */
function bytesOf(color) {
  return [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
}

/** The radio's antenna when a range was taken: on the line between the two keyframes. */
function tagPosition(path, ranges, i) {
  const [before, after, weight] = [ranges.before[i], ranges.after[i], ranges.weight[i] / 255];
  const end = row3(path.centers, after);
  const center = row3(path.centers, before).map((value, axis) => (1 - weight) * value + weight * end[axis]);
  return fromCamera(path, weight < 0.5 ? before : after, ranges.tags_in_cam_m[ranges.tag[i]], center);
}

class RangeLines {
  constructor(ranges, path, anchors) {
    this.ranges = ranges;
    this.numShown = 0;
    const positionOf = new Map(anchors.map((anchor) => [anchor.id, anchor.position]));
    this.hasLine = Array.from(ranges.anchor, (id, i) => ranges.has_place[i] === 1 && positionOf.has(ranges.anchor_ids[id]));
    const ends = this.hasLine.map((known, i) =>
      known
        ? [...tagPosition(path, ranges, i), ...positionOf.get(ranges.anchor_ids[ranges.anchor[i]])]
        : [0, 0, 0, 0, 0, 0],
    );
    this.geometry = lineGeometry(ends);
    this.geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(6 * ranges.num), 3, true));
    const material = new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.9 });
    this.lines = new THREE.LineSegments(this.geometry, material);
    this.lines.frustumCulled = false;
    onTheme(() => this.#paint());
  }

  /** Show the ranges of some statuses, and of one camera only unless it is null. */
  show(statuses, camera) {
    const wanted = camera === null ? [...this.hasLine.keys()] : this.ofCamera(camera);
    const chosen = wanted.filter((i) => this.hasLine[i] && statuses.has(this.ranges.status[i]));
    this.geometry.setIndex(chosen.flatMap((i) => [2 * i, 2 * i + 1]));
    this.numShown = chosen.length;
  }

  /** Numbers of the ranges taken nearest to a camera, in time order. */
  ofCamera(camera) {
    return [...this.ranges.camera.keys()].filter((i) => this.ranges.camera[i] === camera);
  }

  #paint() {
    const stops = RESIDUAL_STOPS.map((name) => bytesOf(themeColor(name)));
    const colors = this.geometry.getAttribute("color");
    for (let i = 0; i < this.ranges.num; i++) {
      const color = residualColor(this.ranges.residual[i] || 0, this.ranges.residual_limit_m, stops);
      colors.array.set([...color, ...color], 6 * i);
    }
    colors.needsUpdate = true;
  }
}
