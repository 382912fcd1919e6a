'use strict';
/* The viewer of room.html (docs/guide/room.md). It needs WebGL 2 and the global THREE of vendor/three.min.js, and reads the data
 * that workflow/room/page.py puts into the page. Nothing is fetched: the page's policy forbids every connection.
 *
 * Axes: z is up, lengths are metres. Light and colours are linear until the last line of the fragment shader.
 *
 * `window.room` is for tests and for people with a console:
 *   ready                        promise, fulfilled when the first picture is drawn
 *   data                         the facts of the page (parts, objects, lamps, photographs, ...)
 *   setLamp(l, strength, color)  strength >= 0; color `#rrggbb` or [r, g, b] linear, null = as found
 *   setMode(name)                lit, albedo, roughness, metallic, emission, uncertainty
 *   setExposure(stops)           0 = as the page opens
 *   setGloss(on)                 whether the evenly lit gloss is added to the diffuse light
 *   setPose(eye, direction)      metres; leaves the view from above
 *   setView(name)                walk, above
 *   showPhotograph(i)            camera of photograph i; -1 = leave it
 *   select(object, part)         as a click does
 *   hit(x, y)                    what lies under a point of the canvas (CSS pixels): part, object, uv, point, normal; or null
 *   pixels()                     {width, height, data}: RGBA bytes of the picture now, bottom row first
 *   light()                      Float32Array, light map of all lamps as it is on the screen, RGB of each stored texel
 *   camera()                     {eye, direction, fov, view}
 *   cost()                       milliseconds that a picture with all pixels takes
 */
(() => {
  const $ = (id) => document.getElementById(id);

  /** Says in one sentence why nothing is shown. */
  function refuse(sentence) {
    $('message').textContent = sentence;
    $('message').hidden = false;
    $('stage').classList.add('refused');
    document.body.classList.add('ready');
  }

  // ------------------------------------------------------------------------------------------------------------- data

  function bytesOf(element) {
    const text = element.textContent;
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const binary = atob(text);
    const bytes = new Uint8Array(binary.length);
    for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
    return bytes;
  }

  /** Takes the bytes of a data block out of the page, so that they are not kept twice. */
  function take(id) {
    const element = $('data-' + id);
    const bytes = bytesOf(element);
    const facts = { ...element.dataset };
    element.remove();
    return { bytes, facts };
  }

  async function inflate(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  /** Undoes `array_blob` of pack.py: bytes in planes, differences along the items of each component. */
  async function decode(id) {
    const { bytes, facts } = take(id);
    const Type = { Uint8Array, Uint16Array, Uint32Array }[facts.type];
    const components = Number(facts.components);
    const items = Number(facts.items);
    const planes = await inflate(bytes);
    const out = new Type(components * items);
    const size = Type.BYTES_PER_ELEMENT;
    const total = components * items;
    for (let c = 0; c < components; c++) {
      let value = 0;
      for (let i = 0; i < items; i++) {
        const at = c * items + i;
        let step = 0;
        for (let b = 0; b < size; b++) step += planes[b * total + at] * 2 ** (8 * b);
        out[i * components + c] = value = (value + step) >>> 0; // storing it takes the rest modulo the range of the type
      }
    }
    return out;
  }

  async function picture(id) {
    const { bytes, facts } = take(id);
    const options = { colorSpaceConversion: 'none', premultiplyAlpha: 'none' };
    return createImageBitmap(new Blob([bytes], { type: facts.kind }), options);
  }

  const halfValues = (() => {
    const out = new Float32Array(0x7c00); // light is never negative
    for (let h = 0; h < out.length; h++) {
      const exponent = h >> 10;
      const fraction = h & 1023;
      out[h] = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : (fraction / 1024) * 2 ** -14;
    }
    return out;
  })();

  const oneFloat = new Float32Array(1);
  const itsBits = new Uint32Array(oneFloat.buffer);
  /** The half float nearest to x >= 0; values above the largest half become the largest. */
  function toHalf(x) {
    if (x < 6.103515625e-5) return Math.round(x * 16777216);
    if (x >= 65504) return 0x7bff;
    oneFloat[0] = x;
    return ((itsBits[0] + 0x1000) >>> 13) - 0x1c000;
  }

  const linearOf = (s) => (s <= 0.04045 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4);
  const srgbOf = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
  const hexOf = (rgb) =>
    '#' + rgb.map((x) => Math.round(255 * srgbOf(Math.min(Math.max(x, 0), 1))).toString(16).padStart(2, '0')).join('');
  const rgbOf = (hex) => [1, 3, 5].map((i) => linearOf(parseInt(hex.slice(i, i + 2), 16) / 255));

  // ---------------------------------------------------------------------------------------------------------- shaders

  const VERTEX = `
    precision highp float;
    uniform mat4 modelMatrix, viewMatrix, projectionMatrix;
    in vec3 position;
    in vec3 normal;
    in vec2 uv;
    out vec3 vPlace;
    out vec3 vNormal;
    out vec2 vUv;
    void main() {
      vec4 place = modelMatrix * vec4(position, 1.0);
      vPlace = place.xyz;
      vNormal = (normal * 255.0 - 128.0) / 127.0;
      vUv = uv;
      gl_Position = projectionMatrix * viewMatrix * place;
    }`;

  const COMMON = `
    precision highp float;
    precision highp sampler2D;
    vec3 encoded(vec3 x) {
      x = clamp(x, 0.0, 1.0);
      return mix(12.92 * x, 1.055 * pow(max(x, 0.0031308), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
    }`;

  // k_d and k_s are those of Eq. R.2; the table holds A_0 and A_1 of Eq. S.22 over cosine (u) and roughness (v).
  const FRAGMENT = COMMON + `
    uniform sampler2D baseMap, surfaceMap, lightMap, lobes, colours;
    uniform vec3 cameraPosition, emission;
    uniform float exposure, gloss, cut, opacity, uncertaintyRange, emissionExposure;
    uniform int mode;
    in vec3 vPlace;
    in vec3 vNormal;
    in vec2 vUv;
    out vec4 colour;
    void main() {
      if (vPlace.z > cut) discard;
      vec3 base = texture(baseMap, vUv).rgb;
      vec4 surface = texture(surfaceMap, vUv);
      float roughness = surface.g, metallic = surface.b;
      vec3 shown;
      if (mode == 0) {
        vec3 light = texture(lightMap, vUv).rgb;
        float cosine = abs(dot(normalize(vNormal), normalize(cameraPosition - vPlace)));
        vec2 cell = vec2(cosine, roughness) * (vec2(textureSize(lobes, 0)) - 1.0) + 0.5;
        vec2 lobe = texture(lobes, cell / vec2(textureSize(lobes, 0))).rg;
        vec3 reflectance = (1.0 - metallic) * base;
        reflectance += gloss * ((0.04 * (1.0 - metallic) + metallic * base) * lobe.r + lobe.g);
        shown = encoded(exposure * (reflectance * light + emission));
      } else if (mode == 1) shown = encoded(base);
      else if (mode == 2) shown = vec3(roughness);
      else if (mode == 3) shown = vec3(metallic);
      else if (mode == 4) shown = encoded(emissionExposure * emission);
      else if (surface.a < 0.5) shown = vec3(0.35); // no photograph shows it
      else shown = texture(colours, vec2(clamp(surface.r * uncertaintyRange, 0.0, 1.0) * (255.0 / 256.0) + 0.5 / 256.0, 0.5)).rgb;
      colour = vec4(shown, opacity);
    }`;

  // Eq. L.7: rows of the map run from +z downwards, columns from +x towards +y, in the axes of the photographs.
  const SKY_FRAGMENT = COMMON + `
    uniform sampler2D skyMap;
    uniform mat3 worldFromRoom;
    uniform vec3 cameraPosition, factor;
    uniform float exposure, emissionExposure;
    uniform int mode;
    in vec3 vPlace;
    out vec4 colour;
    void main() {
      vec3 way = worldFromRoom * normalize(vPlace - cameraPosition);
      vec2 at = vec2(atan(way.y, way.x) / 6.283185307, acos(clamp(way.z, -1.0, 1.0)) / 3.141592654);
      vec3 light = factor * texture(skyMap, vec2(fract(at.x), at.y)).rgb;
      colour = vec4(mode == 0 ? encoded(exposure * light) : mode == 4 ? encoded(emissionExposure * light) : vec3(0.35), 1.0);
    }`;

  const SKY_VERTEX = `
    precision highp float;
    uniform mat4 modelMatrix, viewMatrix, projectionMatrix;
    in vec3 position;
    out vec3 vPlace;
    void main() {
      vec4 place = modelMatrix * vec4(position, 1.0);
      vPlace = place.xyz;
      gl_Position = projectionMatrix * viewMatrix * place;
    }`;

  // What is selected, as a picture of 0 and 1, and a line around it that is seen on light and on dark ground.
  const MASK_FRAGMENT = `
    precision highp float;
    uniform float cut;
    in vec3 vPlace;
    out vec4 colour;
    void main() {
      if (vPlace.z > cut) discard;
      colour = vec4(1.0);
    }`;

  const OUTLINE_VERTEX = `
    in vec3 position;
    void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }`;

  const OUTLINE_FRAGMENT = `
    precision highp float;
    uniform sampler2D mask;
    uniform float reach;
    out vec4 colour;
    float at(vec2 step) {
      ivec2 last = textureSize(mask, 0) - 1;
      return texelFetch(mask, clamp(ivec2(gl_FragCoord.xy + step), ivec2(0), last), 0).r;
    }
    float around(float r) {
      float d = 0.7071 * r;
      return max(max(max(at(vec2(r, 0)), at(vec2(-r, 0))), max(at(vec2(0, r)), at(vec2(0, -r)))),
                 max(max(at(vec2(d, d)), at(vec2(-d, d))), max(at(vec2(d, -d)), at(vec2(-d, -d)))));
    }
    void main() {
      if (at(vec2(0)) > 0.5) discard;
      if (around(2.0 * reach) > 0.5) colour = vec4(1.0, 0.83, 0.3, 1.0);
      else if (around(3.5 * reach) > 0.5) colour = vec4(0.07, 0.09, 0.2, 1.0);
      else discard;
    }`;

  const MODES = ['lit', 'albedo', 'roughness', 'metallic', 'emission', 'uncertainty'];

  // ------------------------------------------------------------------------------------------------------------ start

  async function start() {
    const probe = document.createElement('canvas').getContext('webgl2');
    if (!probe) {
      throw new Error('This page needs WebGL 2, which this browser does not offer: open it in a current Firefox, Chrome, Edge or Safari.');
    }
    if (typeof DecompressionStream === 'undefined' || typeof createImageBitmap === 'undefined') {
      throw new Error('This page needs a browser of 2023 or later: open it in a current Firefox, Chrome, Edge or Safari.');
    }
    // A processor that does the work of a graphics card spends half of it on smooth edges and slanted textures.
    const named = probe.getExtension('WEBGL_debug_renderer_info');
    const bySoftware = !!named && /swiftshader|llvmpipe|software/i.test(probe.getParameter(named.UNMASKED_RENDERER_WEBGL));
    probe.getExtension('WEBGL_lose_context')?.loseContext();
    const data = JSON.parse($('scene').textContent);
    const canvas = $('view');
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: !bySoftware, alpha: false, preserveDrawingBuffer: true, powerPreference: 'high-performance' });
    renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // the shader encodes
    const GROUND = 0x595959;
    renderer.setClearColor(GROUND, 1);
    const scene = new THREE.Scene();
    const camera = new THREE.PerspectiveCamera(70, 1, 0.03, 300);
    camera.up.set(0, 0, 1);

    const [positions, normals, uvs, indices, halves, stored, lobeTable, colourTable, baseImage, surfaceImage] = await Promise.all([
      decode('positions'), decode('normals'), decode('uvs'), decode('indices'), decode('light'), decode('texels'),
      decode('lobes'), decode('colours'), picture('base'), picture('surface'),
    ]);

    // -------------------------------------------------------------------------------------------------------- textures

    function imageTexture(image, colorSpace) {
      const texture = new THREE.Texture(image);
      texture.flipY = false; // v grows downwards, as in glTF
      texture.colorSpace = colorSpace;
      texture.minFilter = THREE.LinearMipmapLinearFilter;
      texture.anisotropy = bySoftware ? 1 : Math.min(4, renderer.capabilities.getMaxAnisotropy());
      texture.needsUpdate = true;
      return texture;
    }

    function halfTexture(values, width, height, filter) {
      const texture = new THREE.DataTexture(values, width, height, THREE.RGBAFormat, THREE.HalfFloatType);
      texture.minFilter = texture.magFilter = filter;
      texture.needsUpdate = true;
      return texture;
    }

    const size = data.light.size;
    const lightValues = new Uint16Array(4 * size * size);
    const lightTexture = halfTexture(lightValues, size, size, THREE.LinearFilter);
    const lobeCount = lobeTable.length / 2;
    const lobeValues = new Uint16Array(4 * lobeCount);
    for (let i = 0; i < lobeCount; i++) for (let c = 0; c < 2; c++) lobeValues[4 * i + c] = toHalf(lobeTable[2 * i + c] / 65535);
    const lobes = halfTexture(lobeValues, data.lobes.cosines, data.lobes.roughnesses, THREE.LinearFilter);
    const colourValues = new Uint8Array(4 * 256);
    for (let i = 0; i < 256; i++) for (let c = 0; c < 3; c++) colourValues[4 * i + c] = colourTable[3 * i + c];
    const colours = new THREE.DataTexture(colourValues, 256, 1, THREE.RGBAFormat);
    colours.minFilter = colours.magFilter = THREE.LinearFilter;
    colours.needsUpdate = true;
    $('legend-bar').style.background = 'linear-gradient(90deg,' + [0, 0.25, 0.5, 0.75, 1].map((t) => {
      const i = 3 * Math.round(255 * t);
      return `rgb(${colourTable[i]},${colourTable[i + 1]},${colourTable[i + 2]})`;
    }).join(',') + ')';
    $('legend-high').textContent = String(data.uncertainty.shown);

    const shared = {
      baseMap: { value: imageTexture(baseImage, THREE.SRGBColorSpace) },
      surfaceMap: { value: imageTexture(surfaceImage, THREE.NoColorSpace) },
      lightMap: { value: lightTexture },
      lobes: { value: lobes },
      colours: { value: colours },
      exposure: { value: 1 },
      gloss: { value: 1 },
      cut: { value: Infinity },
      mode: { value: 0 },
      uncertaintyRange: { value: data.uncertainty.top / data.uncertainty.shown },
      emissionExposure: { value: 1 },
    };

    // -------------------------------------------------------------------------------------------------------- geometry

    const low = data.bounds.low;
    const span = data.bounds.high.map((v, i) => v - low[i]);
    const objectOf = new Map(data.objects.map((object) => [object.id, object]));
    const meshes = data.parts.map((part, number) => {
      const geometry = new THREE.BufferGeometry();
      const [v0, v1, f0, f1] = [part.vertices[0], part.vertices[1], part.faces[0], part.faces[1]];
      geometry.setAttribute('position', new THREE.BufferAttribute(positions.subarray(3 * v0, 3 * v1), 3, true));
      geometry.setAttribute('normal', new THREE.BufferAttribute(normals.subarray(3 * v0, 3 * v1), 3, true));
      geometry.setAttribute('uv', new THREE.BufferAttribute(uvs.subarray(2 * v0, 2 * v1), 2, true));
      geometry.setIndex(new THREE.BufferAttribute(indices.subarray(3 * f0, 3 * f1), 1));
      const material = new THREE.RawShaderMaterial({
        vertexShader: VERTEX, fragmentShader: FRAGMENT, glslVersion: THREE.GLSL3,
        side: part.twoSided ? THREE.DoubleSide : THREE.FrontSide,
        transparent: part.opacity < 1, depthWrite: part.opacity >= 1,
      });
      // The values of shared uniforms are the same objects in all materials, so that setting one sets it for all.
      material.uniforms = {
        ...shared, emission: { value: new THREE.Vector3() }, opacity: { value: part.opacity },
      };
      const mesh = new THREE.Mesh(geometry, material);
      mesh.position.fromArray(low);
      mesh.scale.fromArray(span);
      mesh.userData = { number, part };
      scene.add(mesh);
      return mesh;
    });
    scene.updateMatrixWorld(true);

    const CHOSEN = 1; // layer of what is selected
    let anyChosen = false;
    const mask = new THREE.WebGLRenderTarget(1, 1, { minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter, depthBuffer: false });
    const maskMaterial = new THREE.RawShaderMaterial({
      vertexShader: VERTEX, fragmentShader: MASK_FRAGMENT, glslVersion: THREE.GLSL3, side: THREE.DoubleSide, depthTest: false, depthWrite: false,
    });
    maskMaterial.uniforms = { cut: shared.cut };
    const outlineMaterial = new THREE.RawShaderMaterial({
      vertexShader: OUTLINE_VERTEX, fragmentShader: OUTLINE_FRAGMENT, glslVersion: THREE.GLSL3, depthTest: false, depthWrite: false,
    });
    outlineMaterial.uniforms = { mask: { value: mask.texture }, reach: { value: 1 } };
    const outline = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), outlineMaterial);
    outline.frustumCulled = false;
    const outlineScene = new THREE.Scene().add(outline);

    function drawOutline() {
      mask.setSize(canvas.width, canvas.height);
      outlineMaterial.uniforms.reach.value = canvas.width / canvas.clientWidth;
      scene.overrideMaterial = maskMaterial;
      camera.layers.set(CHOSEN);
      renderer.setRenderTarget(mask);
      renderer.setClearColor(0x000000, 1);
      renderer.render(scene, camera);
      renderer.setRenderTarget(null);
      renderer.setClearColor(GROUND, 1);
      camera.layers.set(0);
      scene.overrideMaterial = null;
      renderer.autoClear = false;
      renderer.render(outlineScene, camera);
      renderer.autoClear = true;
    }

    let sky = null;
    if (data.environment) {
      const bits = await decode('environment');
      const [height, width] = data.environment.shape;
      const values = new Uint16Array(4 * width * height);
      for (let i = 0; i < width * height; i++) {
        for (let c = 0; c < 3; c++) values[4 * i + c] = toHalf(halfValues[bits[3 * i + c]] * data.environment.scale * data.exposure);
      }
      const texture = halfTexture(values, width, height, THREE.NearestFilter);
      const material = new THREE.RawShaderMaterial({
        vertexShader: SKY_VERTEX, fragmentShader: SKY_FRAGMENT, glslVersion: THREE.GLSL3, side: THREE.BackSide, depthWrite: false,
      });
      material.uniforms = {
        exposure: shared.exposure, mode: shared.mode, emissionExposure: shared.emissionExposure,
        skyMap: { value: texture }, factor: { value: new THREE.Vector3(1, 1, 1) },
        worldFromRoom: { value: new THREE.Matrix3().fromArray(data.worldFromRoom) },
      };
      sky = new THREE.Mesh(new THREE.SphereGeometry(100, 32, 16), material);
      sky.renderOrder = -1;
      sky.frustumCulled = false;
      scene.add(sky);
    }

    // ----------------------------------------------------------------------------------------------------------- lamps

    // Each lamp: its light map times strength x colour. Radiance of the whole page is in units of 1 / data.exposure.
    const lamps = data.lamps.map((lamp) => ({ ...lamp, strength: 1, tint: lamp.color.slice() }));
    const texels = halves.length / (3 * Math.max(lamps.length, 1));
    const maps = lamps.map((lamp, l) => {
      const out = new Float32Array(3 * texels);
      const scale = lamp.scale * data.exposure;
      const stride = 3 * lamps.length;
      for (let i = 0; i < texels; i++) {
        for (let c = 0; c < 3; c++) out[3 * i + c] = scale * halfValues[halves[i * stride + 3 * l + c]];
      }
      return out;
    });
    const sum = new Float32Array(3 * texels);
    const factorOf = (lamp) => lamp.tint.map((x) => lamp.strength * x);

    function combineLight() {
      sum.fill(0);
      lamps.forEach((lamp, l) => {
        const [r, g, b] = factorOf(lamp);
        if (r === 0 && g === 0 && b === 0) return;
        const map = maps[l];
        for (let i = 0; i < sum.length; i += 3) {
          sum[i] += r * map[i];
          sum[i + 1] += g * map[i + 1];
          sum[i + 2] += b * map[i + 2];
        }
      });
      for (let i = 0, at = 0; i < texels; i++, at += 3) {
        const to = 4 * stored[i];
        lightValues[to] = toHalf(sum[at]);
        lightValues[to + 1] = toHalf(sum[at + 1]);
        lightValues[to + 2] = toHalf(sum[at + 2]);
      }
      lightTexture.needsUpdate = true;
      meshes.forEach((mesh) => {
        const part = mesh.userData.part;
        const factor = part.lamp >= 0 ? factorOf(lamps[part.lamp]) : [0, 0, 0];
        const emitted = part.radiance.map((x, c) => x * factor[c] * data.exposure);
        mesh.material.uniforms.emission.value.fromArray(emitted);
      });
      if (sky) sky.material.uniforms.factor.value.fromArray(factorOf(lamps[data.environment.lamp]));
      lightDirty = false;
    }

    // ------------------------------------------------------------------------------------------------------- the camera

    const { low: near, high: far } = data.walkable;
    const middle = [0, 1, 2].map((i) => (near[i] + far[i]) / 2);
    const extent = Math.hypot(...[0, 1, 2].map((i) => far[i] - near[i]));
    const pose = {
      view: 'walk', eye: new THREE.Vector3().fromArray(data.start.eye), yaw: data.start.yaw, pitch: data.start.pitch, photograph: -1,
      azimuth: -Math.PI / 2, elevation: 1.05, distance: 0.85 * extent, target: new THREE.Vector3().fromArray(middle),
    };
    pose.target.z = data.floor + 0.3 * (far[2] - data.floor);

    const clamp = (x, a, b) => Math.min(Math.max(x, a), b);
    function keepInside() {
      for (const [axis, i] of [['x', 0], ['y', 1], ['z', 2]]) pose.eye[axis] = clamp(pose.eye[axis], near[i], far[i]);
    }

    const direction = new THREE.Vector3();
    function placeCamera() {
      const width = canvas.clientWidth || 1;
      const height = canvas.clientHeight || 1;
      camera.aspect = width / height;
      camera.fov = width < height ? 80 : 65;
      if (pose.photograph >= 0) {
        const p = data.photographs[pose.photograph];
        const s = Math.min(width / (2 * Math.max(p.cx, p.width - p.cx)), height / (2 * Math.max(p.cy, p.height - p.cy)));
        camera.fov = (2 * Math.atan(height / (2 * s * p.fy)) * 180) / Math.PI;
        const wide = s * (p.fy / p.fx); // pixels need not be square
        const style = $('photograph').style;
        style.left = `${width / 2 - p.cx * wide}px`;
        style.top = `${height / 2 - p.cy * s}px`;
        style.width = `${p.width * wide}px`;
        style.height = `${p.height * s}px`;
        camera.position.fromArray(p.eye);
        camera.up.fromArray(p.up);
        direction.fromArray(p.direction).add(camera.position);
        camera.lookAt(direction);
      } else if (pose.view === 'walk') {
        camera.up.set(0, 0, 1);
        camera.position.copy(pose.eye);
        const c = Math.cos(pose.pitch);
        direction.set(c * Math.cos(pose.yaw), c * Math.sin(pose.yaw), Math.sin(pose.pitch)).add(pose.eye);
        camera.lookAt(direction);
      } else {
        const c = Math.cos(pose.elevation);
        direction.set(c * Math.cos(pose.azimuth), c * Math.sin(pose.azimuth), Math.sin(pose.elevation));
        camera.position.copy(pose.target).addScaledVector(direction, pose.distance);
        camera.up.set(0, 0, 1);
        camera.lookAt(pose.target);
      }
      if (sky) {
        sky.position.copy(camera.position);
        sky.visible = pose.view === 'walk' || pose.photograph >= 0;
      }
      camera.updateProjectionMatrix();
      camera.updateMatrixWorld(true);
    }

    function leavePhotograph() {
      if (pose.photograph < 0) return;
      const p = data.photographs[pose.photograph];
      pose.photograph = -1;
      pose.view = 'walk';
      pose.eye.fromArray(p.eye);
      keepInside();
      pose.yaw = Math.atan2(p.direction[1], p.direction[0]);
      pose.pitch = Math.asin(clamp(p.direction[2], -1, 1));
      showPhotographControls();
    }

    /** Moves forwards, to the right and up, in metres; from above it moves the point that is looked at. */
    function move(forward, right, up) {
      leavePhotograph();
      const angle = pose.view === 'walk' ? pose.yaw : pose.azimuth + Math.PI;
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      const to = pose.view === 'walk' ? pose.eye : pose.target;
      to.x += forward * c + right * s;
      to.y += forward * s - right * c;
      if (pose.view === 'walk') {
        to.z += up;
        keepInside();
      } else {
        to.x = clamp(to.x, near[0], far[0]);
        to.y = clamp(to.y, near[1], far[1]);
        pose.distance = clamp(pose.distance * Math.exp(-up / 3), 0.5, 4 * extent);
      }
      draw();
    }

    function turn(left, up) {
      leavePhotograph();
      if (pose.view === 'walk') {
        pose.yaw += left;
        pose.pitch = clamp(pose.pitch + up, -1.5, 1.5);
      } else {
        pose.azimuth += left;
        pose.elevation = clamp(pose.elevation - up, 0.1, 1.55);
      }
      draw();
    }

    function setView(view) {
      leavePhotograph();
      pose.view = view;
      const above = view === 'above';
      shared.cut.value = above ? data.cut : Infinity;
      meshes.forEach((mesh) => {
        const side = mesh.userData.part.twoSided && !above ? THREE.DoubleSide : THREE.FrontSide;
        if (mesh.material.side !== side) {
          mesh.material.side = side;
          mesh.material.needsUpdate = true;
        }
      });
      document.querySelector(`input[name=way][value=${view}]`).checked = true;
      draw();
    }

    function eyeHeight() {
      leavePhotograph();
      setView('walk');
      pose.eye.z = data.start.eye[2];
      pose.pitch = 0;
      draw();
    }

    // ------------------------------------------------------------------------------------------------------- the picture

    // Where a picture takes long, those that follow one another have fewer pixels, and the last is drawn again with all of them.
    const SMOOTH = 25; // ms that a picture of a movement may take
    const REST = 250; // ms without a change after which it is drawn again
    let lightDirty = true;
    let waiting = false;
    let cost = 0; // ms for a picture with all pixels
    let resting = 0;
    let coarseness = 1;
    function draw() {
      if (waiting) return;
      waiting = true;
      requestAnimationFrame(() => {
        waiting = false;
        // In steps, because every other size of the picture is new memory.
        const wanted = cost > SMOOTH ? Math.max(Math.sqrt(SMOOTH / cost), 0.25) : 1;
        coarseness = 2 ** (Math.floor(2 * Math.log2(wanted)) / 2);
        render(coarseness);
        clearTimeout(resting);
        if (coarseness < 1) resting = setTimeout(() => render(1), REST);
      });
    }

    const onePixel = new Uint8Array(4);
    function render(share) {
      const [width, height] = [canvas.clientWidth, canvas.clientHeight];
      if (!width || !height) return;
      if (lightDirty) combineLight();
      const ratio = share * Math.min(window.devicePixelRatio || 1, 2);
      if (canvas.width !== Math.floor(width * ratio) || canvas.height !== Math.floor(height * ratio)) {
        renderer.setPixelRatio(ratio);
        renderer.setSize(width, height, false);
      }
      placeCamera();
      const begun = performance.now();
      renderer.render(scene, camera);
      if (anyChosen) drawOutline();
      const gl = renderer.getContext();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, onePixel); // waits until it is drawn
      const taken = performance.now() - begun;
      if (share === 1) cost = cost ? 0.5 * cost + 0.5 * taken : 0.1 * taken; // the first picture has to compile and to upload
    }

    // --------------------------------------------------------------------------------------------------------- clicking

    const raycaster = new THREE.Raycaster();
    const pointer = new THREE.Vector2();
    function hit(x, y) {
      placeCamera();
      pointer.set((2 * x) / canvas.clientWidth - 1, 1 - (2 * y) / canvas.clientHeight);
      raycaster.setFromCamera(pointer, camera);
      const found = raycaster.intersectObjects(meshes, false).find((one) => one.point.z <= shared.cut.value);
      if (!found) return null;
      const { number, part } = found.object.userData;
      const normal = found.face.normal.clone();
      return {
        part: number, name: part.name, object: part.object, emitter: part.emitter, uv: found.uv.toArray(), point: found.point.toArray(),
        distance: found.distance, face: found.faceIndex, normal: normal.toArray(),
      };
    }

    const say = (text) => { $('status').textContent = text; };
    const number = (x) => (x === null || x === undefined ? '–' : x === 0 ? '0' : Math.abs(x) >= 100 ? x.toFixed(0) : x.toPrecision(3));

    function row(table, name, value, note) {
      const tr = table.insertRow();
      const th = document.createElement('th');
      th.scope = 'row';
      th.textContent = name;
      tr.append(th);
      const td = tr.insertCell();
      td.textContent = value;
      if (note) {
        const small = document.createElement('span');
        small.className = 'interval';
        small.textContent = ' ' + note;
        td.append(small);
      }
    }

    const grouped = (count) => String(count).replace(/\B(?=(\d{3})+$)/g, '\u202f');
    const between = (value) => (value.low === null || value.low === undefined ? '' : `${number(value.low)} … ${number(value.high)}`);

    /** Shows what is known of an object, or of one part of it; -1 = of nothing. */
    function select(id, partNumber = -1) {
      const part = partNumber >= 0 ? data.parts[partNumber] : null;
      const object = objectOf.get(id);
      meshes.forEach((mesh) => {
        const own = mesh.userData.part;
        const chosen = part ? mesh.userData.number === partNumber || (own.object === id && part.emitter < 0 && own.emitter < 0) : object && own.object === id;
        if (chosen) mesh.layers.enable(CHOSEN);
        else mesh.layers.disable(CHOSEN);
      });
      anyChosen = Boolean(object || part);
      $('card').hidden = !anyChosen;
      const table = $('facts');
      table.replaceChildren();
      $('object').value = object ? String(id) : '';
      $('swatch').hidden = true;
      if (!object && !part) {
        $('object-name').textContent = 'Nothing is selected';
        say('Nothing selected');
        draw();
        return;
      }
      const lamp = part && part.emitter >= 0 && part.lamp >= 0 ? lamps[part.lamp].name : '';
      const name = lamp || (object ? object.name : part.name);
      $('object-name').textContent = name;
      if (lamp && object) row(table, 'on', object.name);
      if (object) {
        if (!part || part.emitter < 0) object.numbers.forEach((one) => row(table, one.name, number(one.value), between(one)));
        row(table, 'fitted', object.model);
        row(table, 'seen by', `${object.views} photograph${object.views === 1 ? '' : 's'}, ${grouped(object.pixels)} pixels`);
        if (object.area !== null) row(table, 'area', `${number(object.area)} m²`);
        if (object.middle) row(table, 'middle', `x, y, z = ${object.middle.map((value) => value.toFixed(2)).join(', ')} m`);
        row(table, 'number', String(object.id));
        $('swatch').style.background = object.color;
        $('swatch').hidden = false;
      }
      if (part && part.emitter >= 0) {
        row(table, 'emitter', String(part.emitter));
        part.emitted.forEach((one) => row(table, one.name, number(one.value), between(one)));
      }
      say(`Selected: ${name}`);
      draw();
    }

    // --------------------------------------------------------------------------------------------------- panel: picture

    function setMode(name) {
      shared.mode.value = MODES.indexOf(name);
      document.querySelector(`input[name=mode][value=${name}]`).checked = true;
      $('legend').hidden = name !== 'uncertainty';
      $('mode-note').textContent = data.notes[name];
      $('exposure').disabled = $('exposure-number').disabled = name !== 'lit' && name !== 'emission';
      $('gloss').disabled = name !== 'lit';
      draw();
    }
    document.querySelectorAll('input[name=mode]').forEach((input) => input.addEventListener('change', () => setMode(input.value)));
    document.querySelectorAll('input[name=way]').forEach((input) => input.addEventListener('change', () => setView(input.value)));
    $('eye-height').addEventListener('click', eyeHeight);

    function setExposure(stops) {
      shared.exposure.value = 2 ** stops;
      shared.emissionExposure.value = (2 ** stops * 0.9) / Math.max(data.brightest * data.exposure, 1e-12);
      $('exposure').value = $('exposure-number').value = String(stops);
      draw();
    }
    for (const id of ['exposure', 'exposure-number']) {
      $(id).addEventListener('input', () => {
        if ($(id).value !== '') setExposure(clamp(Number($(id).value), -10, 10));
      });
    }

    function setGloss(on) {
      shared.gloss.value = on ? 1 : 0;
      $('gloss').checked = on;
      draw();
    }
    $('gloss').addEventListener('change', () => setGloss($('gloss').checked));

    // ----------------------------------------------------------------------------------------------------- panel: lamps

    const controls = lamps.map((lamp, l) => {
      const box = $('lamp-template').content.firstElementChild.cloneNode(true);
      box.querySelector('legend').textContent = lamp.name;
      const [slider, exact, color, off] = ['.strength', '.exact', '.color', '.off'].map((name) => box.querySelector(name));
      slider.setAttribute('aria-label', `strength of ${lamp.name}`);
      exact.setAttribute('aria-label', `strength of ${lamp.name}, as a number`);
      color.setAttribute('aria-label', `colour of ${lamp.name}`);
      slider.addEventListener('input', () => setLamp(l, Number(slider.value)));
      exact.addEventListener('input', () => {
        if (exact.value !== '' && Number(exact.value) >= 0) setLamp(l, Number(exact.value), undefined, true);
      });
      color.addEventListener('input', () => setLamp(l, lamp.strength, color.value));
      off.addEventListener('click', () => setLamp(l, lamp.strength > 0 ? 0 : 1));
      $('lamps').append(box);
      return { slider, exact, color, off };
    });

    function setLamp(l, strength, color, typing = false) {
      const lamp = lamps[l];
      const control = controls[l];
      lamp.strength = Math.max(0, strength);
      if (color === null) lamp.tint = lamp.color.slice();
      else if (color !== undefined) lamp.tint = typeof color === 'string' ? rgbOf(color) : Array.from(color);
      control.slider.value = String(lamp.strength);
      if (!typing) control.exact.value = String(Number(lamp.strength.toFixed(3)));
      control.color.value = hexOf(lamp.tint);
      control.off.textContent = lamp.strength > 0 ? 'off' : 'on';
      control.off.setAttribute('aria-label', `${control.off.textContent}: ${lamp.name}`);
      lightDirty = true;
      draw();
    }
    lamps.forEach((_, l) => setLamp(l, 1));
    $('as-found').addEventListener('click', () => {
      lamps.forEach((_, l) => setLamp(l, 1, null));
      say('All lamps are as they were found');
    });
    $('as-found').hidden = !lamps.length;
    $('no-lamps').hidden = lamps.length > 0;

    // ----------------------------------------------------------------------------------------------- panel: photographs

    const photographUrls = new Map();
    function showPhotographControls() {
      const i = pose.photograph;
      const shown = i >= 0 && data.photographs[i].picture;
      $('photographs').value = i >= 0 ? String(i) : '';
      $('photograph').hidden = !shown;
      $('over').disabled = !shown;
    }

    function showPhotograph(i) {
      if (i < 0) {
        leavePhotograph();
        draw();
        return;
      }
      setView('walk');
      pose.photograph = i;
      const p = data.photographs[i];
      if (p.picture) {
        if (!photographUrls.has(i)) {
          const { bytes, facts } = take(`photograph-${i}`);
          photographUrls.set(i, URL.createObjectURL(new Blob([bytes], { type: facts.kind })));
        }
        $('photograph').src = photographUrls.get(i);
        $('photograph').alt = `Photograph ${p.name}`;
      }
      showPhotographControls();
      say(p.picture ? `Camera of photograph ${p.name}; the slider blends the photograph in` : `Camera of photograph ${p.name}`);
      draw();
    }
    data.photographs.forEach((p, i) => $('photographs').append(new Option(p.name, String(i))));
    $('photographs').addEventListener('change', () => showPhotograph($('photographs').value === '' ? -1 : Number($('photographs').value)));
    const step = (by) => {
      const count = data.photographs.length;
      showPhotograph((Math.max(pose.photograph, by > 0 ? -1 : 0) + by + count) % count);
    };
    $('previous').addEventListener('click', () => step(-1));
    $('next').addEventListener('click', () => step(1));
    const blend = () => { $('photograph').style.opacity = $('over').value; };
    $('over').addEventListener('input', blend);
    blend();
    /** Takes the photograph away: it shows neither other light nor a map. */
    const uncover = () => {
      $('over').value = '0';
      blend();
    };
    $('lamps').addEventListener('input', uncover);
    $('lamps').addEventListener('click', (event) => { if (event.target.closest('.off')) uncover(); });
    document.querySelectorAll('input[name=mode]').forEach((input) => input.addEventListener('change', uncover));
    showPhotographControls();

    // --------------------------------------------------------------------------------------------------- panel: objects

    const FEW = 100; // pixels of all photographs: people look for what is larger
    const byName = [...data.objects].sort((a, b) => a.name.localeCompare(b.name, 'en', { numeric: true }) || a.id - b.id);
    const groups = [['Objects', (object) => object.pixels >= FEW], ['Small, or hardly seen', (object) => object.pixels < FEW]];
    groups.forEach(([title, holds]) => {
      const group = document.createElement('optgroup');
      group.label = title;
      byName.filter(holds).forEach(({ name, id }) => group.append(new Option(`${name} (${id})`, String(id))));
      if (group.children.length) $('object').append(group);
    });
    $('object').addEventListener('change', () => select($('object').value === '' ? -1 : Number($('object').value)));

    $('close').addEventListener('click', () => {
      select(-1);
      canvas.focus({ preventScroll: true });
    });

    $('theme').addEventListener('change', () => { document.documentElement.dataset.theme = $('theme').value; });

    // ------------------------------------------------------------------------------------------- keys, mouse and fingers

    const KEYS = {
      w: [1, 0, 0], s: [-1, 0, 0], a: [0, -1, 0], d: [0, 1, 0], r: [0, 0, 0.6], f: [0, 0, -0.6],
      arrowup: [1, 0, 0], arrowdown: [-1, 0, 0], pageup: [0, 0, 0.6], pagedown: [0, 0, -0.6],
    };
    const TURNS = { arrowleft: 1, arrowright: -1, q: 1, e: -1 };
    const pressed = new Set();
    let last = 0;
    function walk(now) {
      const passed = Math.min(Math.max((now - last) / 1000, 0), 0.1);
      last = now;
      const speed = 1.6 * (pressed.has('shift') ? 2.5 : 1) * passed;
      const way = [0, 0, 0];
      let left = 0;
      pressed.forEach((key) => {
        (KEYS[key] || []).forEach((v, i) => { way[i] += v * speed; });
        left += (TURNS[key] || 0) * 1.4 * passed;
      });
      if (way.some((v) => v)) move(...way);
      if (left) turn(left, 0);
      if (pressed.size) requestAnimationFrame(walk);
    }
    function press(key) {
      if (!pressed.size) {
        last = performance.now();
        requestAnimationFrame(walk);
      }
      pressed.add(key);
    }

    canvas.addEventListener('keydown', (event) => {
      const key = event.key.toLowerCase();
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      if (key in KEYS || key in TURNS || key === 'shift') press(key);
      else if (key >= '1' && key <= String(MODES.length)) setMode(MODES[Number(key) - 1]);
      else if (key === 'home') eyeHeight();
      else if (key === 'v') setView(pose.view === 'walk' ? 'above' : 'walk');
      else if (key === 'n' || key === 'p') { if (data.photographs.length) step(key === 'n' ? 1 : -1); }
      else if (key === 'enter' || key === ' ') click(canvas.clientWidth / 2, canvas.clientHeight / 2);
      else if (key === 'escape') select(-1);
      else return; // tab and the rest stay the browser's
      event.preventDefault();
    });
    const release = (key) => pressed.delete(key);
    window.addEventListener('keyup', (event) => release(event.key.toLowerCase()));
    window.addEventListener('blur', () => pressed.clear());
    canvas.addEventListener('blur', () => pressed.clear());

    function click(x, y) {
      const found = hit(x, y);
      if (found) select(found.object, found.part);
      else select(-1);
    }

    const fingers = new Map();
    let travelled = 0;
    canvas.addEventListener('pointerdown', (event) => {
      canvas.focus({ preventScroll: true });
      canvas.setPointerCapture(event.pointerId);
      if (!fingers.size) travelled = 0;
      fingers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    });
    canvas.addEventListener('pointermove', (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.offsetX - before.x, event.offsetY - before.y];
      travelled += Math.abs(dx) + Math.abs(dy);
      const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      fingers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
      const perPixel = 2.2 / Math.max(canvas.clientWidth, canvas.clientHeight);
      if (travelled < 6) return;
      if (!others.length) {
        if (event.shiftKey || event.buttons === 4) move((dy * perPixel * extent) / 6, (-dx * perPixel * extent) / 6, 0);
        else turn(dx * perPixel, dy * perPixel);
        return;
      }
      // Two fingers: drawn apart they walk forwards or come nearer; moved together they go sideways.
      const from = Math.hypot(before.x - others[0].x, before.y - others[0].y);
      const to = Math.hypot(event.offsetX - others[0].x, event.offsetY - others[0].y);
      const apart = (to - from) * perPixel * 2;
      if (pose.view === 'walk') move(apart, -0.5 * dx * perPixel * 2, 0);
      else move(0.5 * dy * perPixel * 3, -0.5 * dx * perPixel * 3, 3 * apart);
    });
    const lift = (event) => {
      const held = fingers.delete(event.pointerId);
      if (held && event.type === 'pointerup' && travelled < 6 && !fingers.size && event.button === 0) click(event.offsetX, event.offsetY);
    };
    canvas.addEventListener('pointerup', lift);
    canvas.addEventListener('pointercancel', lift);
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      const by = -event.deltaY * (event.deltaMode === 1 ? 30 : 1);
      if (pose.view === 'walk') move(by * 0.0025, 0, 0);
      else move(0, 0, by * 0.004);
    }, { passive: false });

    document.querySelectorAll('#pad button').forEach((button) => {
      const key = button.dataset.key;
      button.addEventListener('pointerdown', (event) => {
        event.preventDefault();
        press(key);
      });
      for (const name of ['pointerup', 'pointercancel', 'pointerleave']) button.addEventListener(name, () => release(key));
      // Enter and space on a button, which have no pointer, go one step.
      button.addEventListener('click', (event) => {
        if (event.detail !== 0) return;
        if (KEYS[key]) move(...KEYS[key].map((v) => 0.3 * v));
        else turn(0.2 * TURNS[key], 0);
      });
    });

    canvas.addEventListener('webglcontextlost', (event) => {
      event.preventDefault();
      refuse('The graphics memory of this device was taken away: reload the page.');
    });
    new ResizeObserver(draw).observe(canvas);

    // -------------------------------------------------------------------------------------------------------- for tests

    Object.assign(window.room, {
      data, setLamp, setMode, setExposure, setGloss, setView, showPhotograph, select, hit,
      setPose(eye, way) {
        setView('walk');
        pose.eye.fromArray(eye);
        pose.yaw = Math.atan2(way[1], way[0]);
        pose.pitch = Math.asin(way[2] / Math.hypot(...way));
        draw();
      },
      pixels() {
        render(1);
        const gl = renderer.getContext();
        const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
        const out = new Uint8Array(4 * width * height);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, out);
        return { width, height, data: out };
      },
      cost: () => cost,
      light() {
        if (lightDirty) combineLight();
        return sum;
      },
      camera() {
        placeCamera();
        camera.getWorldDirection(direction);
        return { eye: camera.position.toArray(), direction: direction.toArray(), fov: camera.fov, view: pose.view };
      },
    });

    setMode('lit');
    setExposure(0);
    setView('walk');
    select(-1);
    say('');
    render(1);
    document.body.classList.add('ready');
  }

  window.room = {};
  window.room.ready = start().catch((error) => {
    refuse(error instanceof Error ? error.message : String(error));
    window.room.failed = true;
  });
})();
