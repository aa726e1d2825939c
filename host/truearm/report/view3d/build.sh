#!/bin/sh
# Write bundle.js from view.js, with the versions of package-lock.json. Nothing of Node stays in this folder.
set -eu
cd "$(dirname "$0")"
work=${1:?a folder to work in}
mkdir -p "$work"
cp package.json package-lock.json view.js "$work"
(cd "$work" && npm ci --silent && node_modules/.bin/esbuild view.js --bundle --minify --format=iife --target=es2020 \
  --banner:js="/* truearm; three.js: Copyright 2010-2026 three.js authors, MIT licence (LICENSE.three) */" --charset=ascii --legal-comments=none --log-level=warning --outfile=bundle.js)
cp "$work/bundle.js" bundle.js
cp "$work/node_modules/three/LICENSE" LICENSE.three
sha256sum bundle.js view.js package.json package-lock.json LICENSE.three > SHA256SUMS
