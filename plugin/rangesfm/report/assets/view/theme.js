// Colours of the view: those of the page's style, so that both change together.

function themeColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Calls back now and whenever the reader's theme changes. */
function onTheme(callback) {
  callback();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", callback);
}
