// Data of the page as CSV files, made when the reader asks for them.

function csvText(rows) {
  const quoted = (text) => (/[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const cell = (value) => (typeof value === "string" ? quoted(asText(value)) : Number.isNaN(value) ? "" : value);
  return `${[Object.keys(rows[0]), ...rows.map(Object.values)].map((row) => row.map(cell).join(",")).join("\n")}\n`;
}

/** Puts an apostrophe before a text that a spreadsheet would take for a formula, as the tables of the result do. */
function asText(text) {
  return /^'*\s*[=+\-@\uff1d\uff0b\uff0d\uff20]/.test(text) && isNaN(text) ? `'${text}` : text;
}

function rounded(value, decimals) {
  return Number(value.toFixed(decimals));
}

function rangeRows(ranges, others) {
  return Array.from({ length: ranges.num }, (_, i) => ({
    time_s: rounded(ranges.time[i], 3),
    anchor_id: ranges.anchor_ids[ranges.anchor[i]],
    range_m: rounded(ranges.measured[i], 4),
    ...others(i),
  }));
}

/** Functions that make the rows of the tables that figures name. */
const TABLES = {
  ranges: ({ ranges }) =>
    rangeRows(ranges, (i) => ({
      residual_scaled_m: rounded(ranges.residual_scaled[i], 4),
      residual_refined_m: rounded(ranges.residual_refined[i], 4),
      status: ranges.statuses[ranges.status[i]],
    })),
  range_errors: ({ ranges }) =>
    rangeRows(ranges, (i) => ({
      range_by_reference_m: rounded(ranges.true[i], 4),
      error_scaled_m: rounded(ranges.residual_scaled[i] + ranges.measured[i] - ranges.true[i], 4),
      error_refined_m: rounded(ranges.residual_refined[i] + ranges.measured[i] - ranges.true[i], 4),
    })),
  points: (scene) =>
    Array.from({ length: scene.points.num }, (_, i) => {
      const [x_m, y_m, z_m] = inFrame(scene, pointPosition(scene.points, i)).map((value) => rounded(value, 4));
      const [red, green, blue] = row3(scene.points.colors, i);
      return { x_m, y_m, z_m, red, green, blue };
    }),
};

/** Returns rows of what the charts of a figure draw. */
function rowsOfCharts(charts) {
  const [x, y] = charts[0].labels.map((label) => (label || "row").replace("−", "minus ").split(/\s+/).join("_"));
  return charts.flatMap((chart) => {
    const number = (row, axis) => chart.number(row[axis], axis, 7);
    return [...chart.rows()].map((row) => ({ panel: chart.title, series: row.name, [x]: number(row, "x"), [y]: number(row, "y") }));
  });
}

/** Makes each CSV button save the table that its figure names, or else what the charts of the figure draw. */
function attachDownloads(scene, figures) {
  for (const button of document.querySelectorAll("button[data-figure]")) {
    button.addEventListener("click", () => {
      const { csv, figure } = button.dataset;
      const text = csvText(csv ? TABLES[csv](scene) : rowsOfCharts(figures[figure]));
      const href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
      Object.assign(document.createElement("a"), { href, download: `${figure}.csv` }).click();
      setTimeout(() => URL.revokeObjectURL(href), 10000);
    });
  }
}
