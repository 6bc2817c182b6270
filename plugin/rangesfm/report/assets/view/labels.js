// Names of anchors over the view, as text of the page.

class Labels {
  constructor(stage, layer) {
    this.stage = stage;
    this.layer = layer;
    this.labels = [];
    stage.on("frame", () => this.#place());
  }

  add(text, position, kind) {
    const node = document.createElement("span");
    node.className = `label ${kind}`;
    node.textContent = text;
    this.layer.append(node);
    const label = { node, position, isWanted: true };
    this.labels.push(label);
    return label;
  }

  /** Show or hide all labels of a kind. */
  toggle(kind, isWanted) {
    for (const label of this.labels) if (label.node.classList.contains(kind)) label.isWanted = isWanted;
  }

  #place() {
    for (const { node, position, isWanted } of this.labels) {
      const pixel = isWanted && position !== null ? this.stage.pixelOf(position) : null;
      node.hidden = pixel === null;
      if (pixel !== null) node.style.transform = `translate(${pixel[0].toFixed(1)}px, ${pixel[1].toFixed(1)}px)`;
    }
  }
}
