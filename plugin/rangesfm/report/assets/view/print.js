// On paper, a picture stands for the view.

function attachPrinting(stage, picture) {
  addEventListener("beforeprint", () => {
    stage.draw(); // what is drawn can be read only at once
    picture.src = stage.canvas.toDataURL("image/png");
  });
}
