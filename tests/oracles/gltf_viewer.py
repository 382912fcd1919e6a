"""An exported glTF file in a browser: three.js and its GLTFLoader open it in headless Chromium, as viewers on the web do.

three.js comes from npm (`make node` puts it into .node); the page has nothing else, and asks for nothing from outside.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.browser import QUIET, SOFTWARE_GL, executable

THREE = Path(__file__).resolve().parents[2] / ".node/node_modules/three"
ADDRESS = "http://viewer.test/"
TYPES = {".js": "text/javascript", ".glb": "model/gltf-binary", ".html": "text/html"}

PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><style>body { margin: 0 }</style>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { RoomEnvironment } from 'three/addons/environments/RoomEnvironment.js';
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true, antialias: false });
document.body.append(renderer.domElement);
const begin = performance.now();
const gltf = await new GLTFLoader().loadAsync('/scene.glb');
const loaded = performance.now() - begin;
const scene = new THREE.Scene();
scene.add(gltf.scene);
scene.environment = new THREE.PMREMGenerator(renderer).fromScene(new RoomEnvironment()).texture;  // as viewers light a model
renderer.toneMapping = THREE.NeutralToneMapping;
scene.updateMatrixWorld(true);
const meshes = [];
gltf.scene.traverse((thing) => { if (thing.isMesh) meshes.push(thing); });

function camera(view) {
  const found = gltf.cameras.find((one) => one.name === 'view_' + view.name || one.name === 'view ' + view.name);
  const own = found.clone(false);
  found.matrixWorld.decompose(own.position, own.quaternion, own.scale);
  // glTF has no principal point: the window is moved over the picture instead.
  own.setViewOffset(view.w, view.h, view.w / 2 - view.cx, view.h / 2 - view.cy, view.w, view.h);
  own.updateMatrixWorld(true);
  return own;
}

const vertex = `
  out vec2 at; out float away;
  void main() {
    vec4 eye = modelViewMatrix * vec4(position, 1.0);
    at = uv; away = -eye.z; gl_Position = projectionMatrix * eye;
  }`;
const fragment = `
  in vec2 at; in float away; out vec4 found;
  uniform sampler2D colours, surfaces; uniform vec3 colour; uniform vec2 factors; uniform bool hasColours, hasSurfaces, second;
  void main() {
    vec3 base = hasColours ? colour * texture(colours, at).rgb : colour;
    vec2 gloss = hasSurfaces ? factors * texture(surfaces, at).gb : factors;
    found = vec4(second ? vec3(gloss, 0.0) : base, away);
  }`;
function bare(material, second) {  // its own textures and factors, without light
  for (const map of [material.map, material.roughnessMap]) {
    if (map) { map.magFilter = map.minFilter = THREE.NearestFilter; map.needsUpdate = true; }
  }
  return new THREE.ShaderMaterial({
    glslVersion: THREE.GLSL3, vertexShader: vertex, fragmentShader: fragment, side: THREE.DoubleSide,
    uniforms: {
      colours: { value: material.map }, surfaces: { value: material.roughnessMap }, colour: { value: material.color },
      factors: { value: new THREE.Vector2(material.roughness, material.metalness) }, second: { value: second },
      hasColours: { value: !!material.map }, hasSurfaces: { value: !!material.roughnessMap },
    },
  });
}

window.shown = (view) => {  // an ordinary picture, by the light of the viewer
  renderer.setSize(view.w, view.h);
  const start = performance.now();
  renderer.render(scene, camera(view));
  const pixels = new Uint8Array(4);
  const gl = renderer.getContext();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return { milliseconds: performance.now() - start, png: renderer.domElement.toDataURL('image/png') };
};
const own = meshes.map((mesh) => mesh.material);
const bared = [false, true].map((second) => own.map((material) => bare(material, second)));
window.values = (view) => {  // linear values and depth of every pixel, rows from the bottom
  const nearest = { minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter };
  const target = new THREE.WebGLRenderTarget(view.w, view.h, { type: THREE.FloatType, ...nearest });
  const eye = camera(view), out = [];
  renderer.setClearColor(0x000000, 0);
  for (const materials of bared) {
    meshes.forEach((mesh, number) => { mesh.material = materials[number]; });
    renderer.setRenderTarget(target);
    renderer.clear();
    renderer.render(scene, eye);
    const data = new Float32Array(4 * view.w * view.h);
    renderer.readRenderTargetPixels(target, 0, 0, view.w, view.h, data);
    let text = '';
    for (const byte of new Uint8Array(data.buffer)) text += String.fromCharCode(byte);
    out.push(btoa(text));
  }
  renderer.setRenderTarget(null);
  meshes.forEach((mesh, number) => { mesh.material = own[number]; });
  target.dispose();
  return out;
};
const lamps = {};
for (const material of own) {
  const strength = material.emissiveIntensity ?? 0;
  const shines = material.emissive ? material.emissive.toArray().map((value) => value * strength) : [0, 0, 0];
  if (Math.max(...shines) > 0) lamps[material.name] = shines;
}
window.facts = { loaded, meshes: meshes.length, cameras: gltf.cameras.length, lamps, revision: THREE.REVISION };
</script>"""


@dataclass(frozen=True)
class Opened:
    """What the browser made of a file.

    Attributes:
        seconds: until the file was parsed and its textures decoded; first: until the first picture after that.
        facts: meshes, cameras, radiance of the lamps (by material), revision of three.js.
        complaints: errors and warnings of the console, and exceptions.
        requests: addresses that the page asked for.
        picture: PNG file of the first view.
        values: for each view (H W, 5): linear base colour, roughness, metallic.
        depth: for each view (H W,) metres along the camera's axis, infinite where nothing is.
    """

    seconds: float
    first: float
    facts: dict[str, Any]
    complaints: list[str]
    requests: list[str]
    picture: bytes
    values: list[np.ndarray]
    depth: list[np.ndarray]


def available() -> bool:
    """Whether there is a browser, and three.js."""
    return executable() is not None and THREE.is_dir()


def open_in_browser(glb: Path, views: Sequence[Any], limit: float = 120) -> Opened:
    """Open a file and look at it from some of the photographs' cameras (`workflow.scene.normal_form.View`)."""
    from playwright.sync_api import sync_playwright

    frames = [{"name": v.name, "w": v.width, "h": v.height, "cx": v.cx, "cy": v.cy} for v in views]
    complaints: list[str] = []
    requests: list[str] = []

    def answer(route: Any) -> None:
        name = route.request.url.removeprefix(ADDRESS)
        requests.append(name)
        path = glb if name == "scene.glb" else THREE / name.removeprefix("three/") if name.startswith("three/") else None
        if not name:
            route.fulfill(body=PAGE, content_type=TYPES[".html"])
        elif path is None or not path.is_file():
            route.fulfill(status=404)
        else:
            route.fulfill(body=path.read_bytes(), content_type=TYPES.get(path.suffix, "application/octet-stream"))

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=executable(), args=[*QUIET, *SOFTWARE_GL])
        try:
            page = chromium.new_page(viewport={"width": 800, "height": 600})
            page.set_default_timeout(1000 * limit)
            page.on("console", lambda message: message.type in ("error", "warning") and complaints.append(message.text))
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.route("**/*", answer)
            page.goto(ADDRESS)
            page.wait_for_function("window.facts || false")
            facts = page.evaluate("window.facts")
            shown = page.evaluate("(view) => shown(view)", frames[0])
            values, depth = [], []
            for frame in frames:
                pictures = [_rows(text, frame) for text in page.evaluate("(view) => values(view)", frame)]
                values.append(np.concatenate([pictures[0][:, :3], pictures[1][:, :2]], 1).astype(np.float64))
                depth.append(np.where(pictures[0][:, 3] > 0, pictures[0][:, 3], np.inf))
        finally:
            chromium.close()
    picture = base64.b64decode(shown["png"].partition(",")[2])
    times = facts.pop("loaded") / 1000, shown["milliseconds"] / 1000
    return Opened(*times, json.loads(json.dumps(facts)), complaints, requests, picture, values, depth)


def _rows(text: str, frame: dict[str, Any]) -> np.ndarray:
    """(H W, 4), rows from the top."""
    pixels = np.frombuffer(base64.b64decode(text), np.float32).reshape(frame["h"], frame["w"], 4)
    return pixels[::-1].reshape(-1, 4)
