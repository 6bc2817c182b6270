#!/usr/bin/env bash
# Makes three.min.js, one classic script with the global THREE, from three_parts.mjs. Needs node and npm.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp "$here/three_parts.mjs" "$work"
cd "$work"
npm install --no-save --silent three@0.187.0 esbuild@0.28.2
npx esbuild three_parts.mjs --bundle --minify --format=iife --global-name=THREE --target=es2020 --outfile=three.min.js
{
  printf '/* three.js 0.187.0, MIT licence, see three.LICENSE */\n'
  cat three.min.js
} > "$here/three.min.js"
cp node_modules/three/LICENSE "$here/three.LICENSE"
