#!/usr/bin/env bash
# Makes three.min.js again: the parts of three.js that viewer.js uses, as one classic script that sets the global THREE.
# Needs npm. The same versions give the same bytes; a test compares the file with the hash in README.md.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
npm install --prefix "$work" --no-save --no-audit --no-fund --silent three@0.187.0 esbuild@0.28.2
cat > "$work/parts.js" <<'PARTS'
export {
  BackSide, BufferAttribute, BufferGeometry, DataTexture, DoubleSide, FrontSide, GLSL3, HalfFloatType,
  LinearFilter, LinearMipmapLinearFilter, LinearSRGBColorSpace, Matrix3, Mesh, NearestFilter, NoColorSpace, PerspectiveCamera, PlaneGeometry, Raycaster,
  RawShaderMaterial, RGBAFormat, Scene, SphereGeometry, SRGBColorSpace, Texture, Vector2, Vector3, WebGLRenderer, WebGLRenderTarget,
} from 'three';
PARTS
"$work/node_modules/.bin/esbuild" "$work/parts.js" --bundle --minify --format=iife --global-name=THREE --target=es2020 \
  --legal-comments=inline --charset=ascii --outfile="$here/three.min.js"
cp "$work/node_modules/three/LICENSE" "$here/LICENSE"
sha256sum "$here/three.min.js" | cut -d' ' -f1
