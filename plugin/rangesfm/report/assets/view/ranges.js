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
  const tagInCam = ranges.tags_in_cam_m[ranges.tag[i]];
  const nearest = weight < 0.5 ? before : after;
  const rotation = path.rotations.subarray(9 * nearest, 9 * nearest + 9);
  return [0, 1, 2].map((axis) => {
    const center = (1 - weight) * path.centers[3 * before + axis] + weight * path.centers[3 * after + axis];
    const lever = rotation.subarray(3 * axis, 3 * axis + 3);
    return center + lever[0] * tagInCam[0] + lever[1] * tagInCam[1] + lever[2] * tagInCam[2];
  });
}

class RangeLines {
  constructor(ranges, path, anchors) {
    this.ranges = ranges;
    this.statuses = new Set();
    this.camera = null;
    this.numShown = 0;
    const positionOf = new Map(anchors.map((anchor) => [anchor.id, anchor.position]));
    this.hasLine = Array.from(ranges.anchor, (id, i) => ranges.has_place[i] === 1 && positionOf.has(ranges.anchor_ids[id]));
    const ends = this.hasLine.map((known, i) =>
      known
        ? [...tagPosition(path, ranges, i), ...positionOf.get(ranges.anchor_ids[ranges.anchor[i]])]
        : [0, 0, 0, 0, 0, 0],
    );
    this.geometry = new THREE.BufferGeometry();
    this.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(ends.flat()), 3));
    this.geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(6 * ranges.num), 3, true));
    const material = new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.9 });
    this.lines = new THREE.LineSegments(this.geometry, material);
    this.lines.frustumCulled = false;
    onTheme(() => this.#paint());
  }

  /** Show the ranges of some statuses, and of one camera only unless it is null. */
  show(statuses, camera) {
    const chosen = [];
    for (let i = 0; i < this.ranges.num; i++) {
      if (this.hasLine[i] && statuses.has(this.ranges.status[i]) && (camera === null || this.ranges.camera[i] === camera)) {
        chosen.push(2 * i, 2 * i + 1);
      }
    }
    this.geometry.setIndex(chosen);
    this.numShown = chosen.length / 2;
  }

  /** Numbers of the ranges taken nearest to a camera, in time order. */
  ofCamera(camera) {
    const chosen = [];
    for (let i = 0; i < this.ranges.num; i++) if (this.ranges.camera[i] === camera) chosen.push(i);
    return chosen;
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
