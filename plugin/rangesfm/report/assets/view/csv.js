// Data of the page as CSV files, made when asked for.

function csvCell(value) {
  const text = typeof value === "number" ? (Number.isFinite(value) ? String(value) : "") : String(value);
  return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

function csvText(header, num, rowAt) {
  const lines = [header.join(",")];
  for (let i = 0; i < num; i++) lines.push(rowAt(i).map(csvCell).join(","));
  return `${lines.join("\n")}\n`;
}

function rounded(value, decimals) {
  return Number.isFinite(value) ? Number(value.toFixed(decimals)) : NaN;
}

const CSV_TABLES = {
  ranges: ({ ranges }) =>
    csvText(
      ["time_s", "anchor_id", "range_m", "residual_scaled_m", "residual_refined_m", "status"],
      ranges.num,
      (i) => [
        rounded(ranges.time[i], 3),
        ranges.anchor_ids[ranges.anchor[i]],
        rounded(ranges.measured[i], 4),
        rounded(ranges.residual_scaled[i], 4),
        rounded(ranges.residual_refined[i], 4),
        ranges.statuses[ranges.status[i]],
      ],
    ),
  range_errors: ({ ranges }) =>
    csvText(["time_s", "anchor_id", "range_m", "range_by_reference_m", "error_scaled_m", "error_refined_m"], ranges.num, (i) => {
      const fromReference = ranges.measured[i] - ranges.true[i];
      return [
        rounded(ranges.time[i], 3),
        ranges.anchor_ids[ranges.anchor[i]],
        rounded(ranges.measured[i], 4),
        rounded(ranges.true[i], 4),
        rounded(ranges.residual_scaled[i] + fromReference, 4),
        rounded(ranges.residual_refined[i] + fromReference, 4),
      ];
    }),
  points: ({ points }) =>
    csvText(["x_m", "y_m", "z_m", "red", "green", "blue"], points.num, (i) => [
      ...pointPosition(points, i).map((value) => rounded(value, 4)),
      ...row3(points.colors, i),
    ]),
};

/** A figure's button gives the table it names, or else what its charts draw. */
function attachDownloads(scene, figures) {
  for (const button of document.querySelectorAll("button[data-figure]")) {
    button.addEventListener("click", () => {
      const { csv, figure } = button.dataset;
      const text = csv ? CSV_TABLES[csv](scene) : csvOfFigure(figures[figure]);
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
      link.download = `${figure}.csv`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }
}
