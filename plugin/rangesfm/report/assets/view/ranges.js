// Ranges, drawn as lines from the tag at the camera to the anchor and coloured by residual.

const RESIDUAL_COLORS = ["residual-negative", "residual-zero", "residual-positive"];

/** Returns the position of the tag when a range was taken, interpolated between two keyframes. */
function tagPosition(path, ranges, i) {
  const [before, after, weight] = [ranges.before[i], ranges.after[i], ranges.weight[i] / 255];
  const end = row3(path.centers, after);
  const center = row3(path.centers, before).map((value, axis) => (1 - weight) * value + weight * end[axis]);
  return fromCamera(path, weight < 0.5 ? before : after, ranges.tags_in_cam_m[ranges.tag[i]], center);
}

class RangeLines {
  constructor(ranges, path, anchors) {
    Object.assign(this, { ranges, numShown: 0 });
    const positionOf = new Map(anchors.map((anchor) => [anchor.id, anchor.position]));
    const anchorAt = Array.from(ranges.anchor, (number) => positionOf.get(ranges.anchor_ids[number]));
    this.hasLine = anchorAt.map((anchor, i) => anchor !== undefined && ranges.has_place[i] === 1);
    const nowhere = [[0, 0, 0], [0, 0, 0]];
    const ends = anchorAt.flatMap((anchor, i) => (this.hasLine[i] ? [tagPosition(path, ranges, i), anchor] : nowhere));
    this.geometry = lineGeometry(ends);
    this.geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(6 * ranges.num), 3));
    const material = new THREE.LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.9 });
    this.lines = new THREE.LineSegments(this.geometry, material);
    this.lines.frustumCulled = false;
    onTheme(() => this.#paint());
  }

  /** Shows the ranges of some statuses: those of one camera, or all where camera is null. */
  show(statuses, camera) {
    const wanted = camera === null ? [...this.hasLine.keys()] : this.ofCamera(camera);
    const chosen = wanted.filter((i) => this.hasLine[i] && statuses.has(this.ranges.status[i]));
    this.geometry.setIndex(chosen.flatMap((i) => [2 * i, 2 * i + 1]));
    this.numShown = chosen.length;
  }

  /** Returns the numbers of the ranges taken nearest to a camera, in order of time. */
  ofCamera(camera) {
    return [...this.ranges.camera.keys()].filter((i) => this.ranges.camera[i] === camera);
  }

  /** Colours each line by its residual: from the middle colour at 0 to an end colour at the limit, fast at first. */
  #paint() {
    const [negative, zero, positive] = RESIDUAL_COLORS.map((name) => new THREE.Color(themeColor(name)));
    const colors = this.geometry.getAttribute("color");
    const color = new THREE.Color();
    this.ranges.residual.forEach((residual, i) => {
      const share = Math.sqrt(Math.min(1, Math.abs(residual || 0) / this.ranges.residual_limit_m));
      color.lerpColors(zero, residual < 0 ? negative : positive, share);
      for (const end of [2 * i, 2 * i + 1]) colors.setXYZ(end, color.r, color.g, color.b);
    });
    colors.needsUpdate = true;
  }
}
