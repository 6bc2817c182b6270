#!/usr/bin/env bash
# Makes three.min.js and vega.min.js, classic scripts with the globals THREE and VEGA, from three_parts.mjs and
# vega_parts.mjs. Needs node and npm.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp "$here"/*_parts.mjs "$work"
cd "$work"
npm install --no-save --silent three@0.187.0 vega@6.4.0 vega-lite@6.4.2 vega-interpreter@2.3.2 esbuild@0.28.2

bundle() { # parts, global, first line, options
  npx esbuild "$1_parts.mjs" --bundle --minify --format=iife --global-name="$2" --outfile="$1.min.js" "${@:4}"
  {
    printf '/* %s */\n' "$3"
    cat "$1.min.js"
  } > "$here/$1.min.js"
}
bundle three THREE "three.js 0.187.0, MIT licence, see three.LICENSE" --target=es2020
# Vega-Lite takes a few helpers from the whole of Vega: those are vega-util's.
bundle vega VEGA "Vega 6.4.0, Vega-Lite 6.4.2 and d3, BSD-3-Clause and ISC licences, see vega.LICENSE" \
  --target=es2022 --charset=utf8 --legal-comments=none --alias:vega=vega-util

cp node_modules/three/LICENSE "$here/three.LICENSE"
{
  for package in vega vega-lite d3-array d3-ease d3-geo d3-scale-chromatic internmap topojson-client; do
    printf '%s\n\n' "$package:"
    cat "node_modules/$package/LICENSE"
    printf '\n'
  done
} > "$here/vega.LICENSE"
