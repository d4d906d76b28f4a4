// The interactive view of a report page: a surface and its maps to the sphere or to a torus, drawn with three.js
// (global THREE).
//
// The page carries two elements: #scene, JSON with sizes, ranges and stages; and #scene-data, the vertex data, deflated
// and in base64. What a vertex has is listed in omtwarp/reporting/scene.py, which writes both; of a torus, in torus_scene.py. Textures are
// looked up per pixel by direction in a cube map, so there is no seam and no pole; on a torus, in a picture that
// repeats. Whatever fails, the still picture stays.
(() => {
  'use strict';

  const root = document.documentElement;
  const stage = document.getElementById('viewer');
  const canvas = document.getElementById('viewer-canvas');
  const calm = window.matchMedia('(prefers-reduced-motion: reduce)').matches;

  const REPEAT = 1000; // three.js's RepeatWrapping, which three.min.js does not export

  const VERTEX = `
    attribute vec3 directionFrom, directionTo;
    attribute float areaFrom, areaTo, angleFrom, angleTo;
    uniform float change, morph, radius, flatFrom, flatTo;
    #ifdef PLACED
    attribute vec4 placeFrom, placeTo;
    #endif
    #ifdef RING
    attribute vec2 latticeFrom, latticeTo;
    uniform float ring;
    varying vec2 lattice;
    #endif
    uniform mat3 turn;
    varying vec3 direction, normalEye, positionEye;
    varying float area, angle;
    void main() {
      direction = mix(directionFrom, directionTo, change);
      vec3 onSphere = normalize(direction + vec3(1e-9));
      // The disk by Lambert's projection of the hemisphere.
      vec3 onDisk = vec3(onSphere.xy * sqrt(2.0 / max(1.0 + onSphere.z, 1e-9)), 0.0);
      float lying = mix(flatFrom, flatTo, change);
      #ifdef PLACED
      vec4 place = mix(placeFrom, placeTo, change);
      #else
      vec4 place = vec4(0.0, 0.0, 0.0, radius);
      #endif
      vec3 placed = mix(position, place.xyz + place.w * (turn * mix(onSphere, onDisk, lying)), morph);
      vec3 outward = turn * mix(onSphere, vec3(0.0, 0.0, 1.0), lying);
      #ifdef RING
      // Directions are points of the ring torus; outward is away from the circle in the middle of its tube.
      placed = mix(position, radius * (turn * direction), morph);
      outward = turn * normalize(direction - vec3(ring * normalize(direction.xy + vec2(1e-9)), 0.0));
      lattice = mix(latticeFrom, latticeTo, change);
      #endif
      area = mix(areaFrom, areaTo, change);
      angle = mix(angleFrom, angleTo, change);
      normalEye = normalMatrix * mix(normal, outward, morph);
      vec4 eye = modelViewMatrix * vec4(placed, 1.0);
      positionEye = eye.xyz;
      gl_Position = projectionMatrix * eye;
    }`;

  const FRAGMENT = `
    uniform int colouring;
    #ifdef RING
    uniform sampler2D picture;
    uniform vec3 lines;
    varying vec2 lattice;
    #else
    uniform samplerCube picture;
    #endif
    uniform sampler2D areaColours, angleColours;
    varying vec3 direction, normalEye, positionEye;
    varying float area, angle;

    vec3 linear(vec3 c) { return pow(c, vec3(2.2)); }

    // The cube's faces are equiangular: equal steps on the picture are equal angles.
    vec3 equiangular(vec3 d) {
      vec3 a = abs(d);
      float m = max(a.x, max(a.y, a.z));
      return atan(d, vec3(m)) * 1.2732395447351628;
    }

    // Anti-aliased line where x is a whole number; width in pixels.
    float line(float x, float width) {
      float w = fwidth(x);
      float off = abs(fract(x - 0.5) - 0.5);
      return (1.0 - smoothstep(0.5 * width - 0.5, 0.5 * width + 0.5, off / max(w, 1e-6))) * (1.0 - smoothstep(0.25, 0.6, w));
    }

    #ifdef RING
    vec3 pictured() { return texture2D(picture, lattice, -0.5).rgb; }

    // Lines along both vectors that the torus repeats along, and a thick one where it closes.
    vec3 ruled() {
      vec2 at = lattice * lines.xy;
      float thin = max(line(at.x, 1.6), line(at.y, 1.6)), thick = max(line(lattice.x, 4.0), line(lattice.y, 4.0));
      vec2 wave = 0.5 + 0.5 * cos(6.283185307179586 * lattice);
      vec3 base = mix(vec3(0.93, 0.90, 0.84), vec3(0.62, 0.74, 0.84), wave.y);
      base = mix(base, vec3(0.87, 0.66, 0.55), 0.6 * wave.x);
      return mix(base, vec3(0.10, 0.14, 0.22), 0.85 * max(thin, thick));
    }
    #else
    vec3 pictured() { return textureCube(picture, equiangular(normalize(direction)), -0.5).rgb; }

    vec3 graticule(vec3 d) {
      float latitude = asin(clamp(d.z, -1.0, 1.0));
      // Of two cuts of the longitude the one that is not here, so that its jump is not taken for a line.
      float a = atan(d.y, d.x), b = atan(-d.y, -d.x);
      float la = a * 3.819718634205488, lb = b * 3.819718634205488;
      float meridians = fwidth(la) < fwidth(lb) ? line(la, 1.6) : line(lb, 1.6);
      float parallels = line(latitude * 3.819718634205488, 1.6);
      vec3 base = mix(vec3(0.93, 0.90, 0.84), vec3(0.62, 0.74, 0.84), smoothstep(-0.15, 0.15, d.z));
      base = mix(vec3(0.87, 0.66, 0.55), base, smoothstep(-1.05, 0.05, d.z));
      return mix(base, vec3(0.10, 0.14, 0.22), 0.85 * max(meridians * step(abs(latitude), 1.5), parallels));
    }

    vec3 ruled() { return graticule(normalize(direction)); }
    #endif

    void main() {
      vec3 base = vec3(0.80, 0.80, 0.79);
      if (colouring == 0) base = pictured();
      else if (colouring == 1) base = ruled();
      else if (colouring == 2) base = texture2D(areaColours, vec2(area, 0.5)).rgb;
      else if (colouring == 3) base = texture2D(angleColours, vec2(angle, 0.5)).rgb;
      base = linear(base);

      vec3 n = normalize(normalEye);
      vec3 v = normalize(-positionEye);
      if (dot(n, v) < 0.0) n = -n;
      vec3 key = normalize(vec3(-0.45, 0.75, 0.65)), fill = normalize(vec3(0.8, -0.1, 0.5));
      float lambert = max(0.0, dot(n, key));
      vec3 light = mix(vec3(0.30, 0.29, 0.31), vec3(0.44, 0.47, 0.52), 0.5 + 0.5 * n.y);
      light += vec3(0.66, 0.64, 0.60) * lambert + vec3(0.11, 0.12, 0.15) * max(0.0, dot(n, fill));
      vec3 h = normalize(key + v);
      float gloss = 0.10 * pow(max(0.0, dot(n, h)), 48.0) * lambert;
      float rim = 0.14 * pow(1.0 - max(0.0, dot(n, v)), 3.0) * (0.5 + 0.5 * n.y);
      vec3 lit = base * light + gloss + rim * mix(base, vec3(1.0), 0.4);
      gl_FragColor = vec4(pow(min(lit, vec3(1.0)), vec3(1.0 / 2.2)), 1.0);
    }`;

  const EDGE_FRAGMENT = `
    uniform vec3 ink;
    uniform float strength;
    void main() { gl_FragColor = vec4(ink, strength); }`;

  start().catch((reason) => giveUp(reason));

  function giveUp(reason) {
    root.dataset.viewer = 'still';
    stage.classList.add('is-still');
    const note = document.getElementById('viewer-note');
    note.textContent = 'This browser cannot draw in 3D here (WebGL 2 is missing or switched off), so this is a picture.';
    note.hidden = false;
    console.info('omtwarp report: no interactive view:', reason && reason.message ? reason.message : reason);
  }

  async function start() {
    const scene = JSON.parse(document.getElementById('scene').textContent);
    const probe = document.createElement('canvas').getContext('webgl2');
    if (!probe) throw new Error('no WebGL 2');
    const releaser = probe.getExtension('WEBGL_lose_context');
    if (releaser) releaser.loseContext();
    const bytes = await inflate(document.getElementById('scene-data').textContent);
    const pictures = await Promise.all(scene.picture.map(load));
    show(scene, bytes, pictures);
  }

  async function inflate(text) {
    const packed = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
    return new Response(stream).arrayBuffer();
  }

  function load(source) {
    return new Promise((resolve, reject) => {
      const image = new Image();
      image.onload = () => resolve(image);
      image.onerror = () => reject(new Error('a face of the texture cannot be decoded'));
      image.src = source;
    });
  }

  // A picture that repeats both ways, its lowest row first.
  function repeating(image) {
    const { width, height } = image;
    const page = document.createElement('canvas').getContext('2d');
    Object.assign(page.canvas, { width, height });
    page.setTransform(1, 0, 0, -1, 0, height);
    page.drawImage(image, 0, 0);
    const texels = new Uint8Array(page.getImageData(0, 0, width, height).data.buffer);
    const texture = new THREE.DataTexture(texels, width, height, THREE.RGBAFormat);
    texture.wrapS = texture.wrapT = REPEAT;
    return texture;
  }

  function show(scene, buffer, pictures) {
    const part = (name, Type, width, normalised) => {
      const [offset, count] = scene.arrays[name];
      return new THREE.BufferAttribute(new Type(buffer, offset, count), width, normalised);
    };
    const shape = new THREE.BufferGeometry();
    shape.setAttribute('position', part('position', Int16Array, 3, true));
    shape.setAttribute('normal', part('normal', Int16Array, 3, true));
    const triangles = new Uint32Array(buffer, ...scene.arrays.index);
    shape.setIndex(new THREE.BufferAttribute(triangles, 1));
    const placed = `place-${scene.stages[0].key}` in scene.arrays;
    const perStage = scene.stages.map(({ key }) => ({
      direction: part(`direction-${key}`, Int16Array, 3, true),
      area: part(`area-${key}`, Uint8Array, 1, true),
      angle: part(`angle-${key}`, Uint8Array, 1, true),
      ...(placed ? { place: part(`place-${key}`, Float32Array, 4, false) } : {}),
      ...(scene.ring ? { lattice: part(`lattice-${key}`, Float32Array, 2, false) } : {}),
    }));

    const picture = scene.ring ? repeating(pictures[0]) : new THREE.CubeTexture(pictures);
    picture.flipY = false;
    picture.generateMipmaps = true;
    picture.minFilter = THREE.LinearMipmapLinearFilter;
    picture.magFilter = THREE.LinearFilter;
    picture.needsUpdate = true;
    const ramp = (hex) => {
      const size = hex.length / 6;
      const data = new Uint8Array(4 * size).fill(255);
      for (let k = 0; k < 3 * size; k++) data[4 * Math.floor(k / 3) + (k % 3)] = parseInt(hex.substr(2 * k, 2), 16);
      const texture = new THREE.DataTexture(data, size, 1, THREE.RGBAFormat);
      texture.magFilter = texture.minFilter = THREE.LinearFilter;
      texture.needsUpdate = true;
      return texture;
    };

    const uniforms = {
      change: { value: 1 },
      morph: { value: 0 },
      radius: { value: scene.radius },
      flatFrom: { value: 0 },
      flatTo: { value: 0 },
      turn: { value: new THREE.Matrix3().fromArray(scene.turn) },
      colouring: { value: 0 },
      picture: { value: picture },
      ring: { value: scene.ring ? scene.ring.radius : 0 },
      lines: { value: new THREE.Vector3(...(scene.ring ? scene.ring.lines : [0, 0]), 0) },
      areaColours: { value: ramp(scene.area.colours) },
      angleColours: { value: ramp(scene.angle.colours) },
      ink: { value: new THREE.Vector3(0.05, 0.07, 0.12) },
      strength: { value: 0.3 },
    };
    const defines = { ...(placed ? { PLACED: 1 } : {}), ...(scene.ring ? { RING: 1 } : {}) };
    const material = new THREE.ShaderMaterial({
      uniforms,
      defines,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: 2,
      polygonOffset: true,
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 1,
    });
    const world = new THREE.Scene();
    const mesh = new THREE.Mesh(shape, material);
    mesh.frustumCulled = false;
    world.add(mesh);
    let wire = null;

    const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, powerPreference: 'low-power' });
    renderer.setClearColor(0x000000, 0);
    picture.anisotropy = renderer.capabilities.getMaxAnisotropy();
    const camera = new THREE.PerspectiveCamera(24, 1, 0.05, 60);
    const controls = new THREE.OrbitControls(camera, canvas);
    controls.enableDamping = !calm;
    controls.enablePan = false;
    controls.minDistance = 1.3;
    controls.maxDistance = 16;
    controls.autoRotateSpeed = 1.1;
    controls.autoRotate = !calm && !root.dataset.still && !navigator.webdriver;
    // A wheel over the view scrolls the page until the view was asked for.
    controls.enableZoom = false;
    canvas.addEventListener('pointerdown', () => { controls.enableZoom = true; });
    canvas.addEventListener('blur', () => { controls.enableZoom = false; });
    controls.addEventListener('start', () => { controls.autoRotate = false; });

    // Near enough to fill the view, far enough that nothing leaves it while the surface turns.
    const fittingDistance = (elevation) => {
      const points = shape.attributes.position.array;
      const up = 0.94 * Math.tan((camera.fov * Math.PI) / 360);
      const across = up * camera.aspect;
      const [c, s] = [Math.cos(elevation), Math.sin(elevation)];
      let needed = 0;
      for (let turn = 0; turn < 24; turn++) {
        const [ct, st] = [Math.cos((turn * Math.PI) / 12), Math.sin((turn * Math.PI) / 12)];
        for (let k = 0; k < points.length; k += 3) {
          const x = ct * points[k] + st * points[k + 2];
          const z = ct * points[k + 2] - st * points[k];
          const y = points[k + 1];
          const near = z * c + y * s;
          needed = Math.max(needed, near + Math.abs(y * c - z * s) / up, near + Math.abs(x) / across);
        }
      }
      return needed / 32767;
    };
    const home = () => {
      const azimuth = (scene.azimuth * Math.PI) / 180;
      const elevation = (scene.elevation * Math.PI) / 180;
      const distance = Math.max(fittingDistance(elevation), (1.05 * scene.radius) / Math.sin((camera.fov * Math.PI) / 360));
      camera.position.set(
        distance * Math.cos(elevation) * Math.sin(azimuth),
        distance * Math.sin(elevation),
        distance * Math.cos(elevation) * Math.cos(azimuth),
      );
      controls.target.set(0, 0, 0);
      controls.update();
    };

    // Changes are eased over time; `dirty` asks for a frame, and none is drawn where nothing moves.
    let dirty = true;
    let current = -1;
    let morphGoal = 0;
    const resize = () => {
      const { clientWidth: width, clientHeight: height } = canvas.parentElement;
      if (!width || !height) return;
      renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      dirty = true;
    };
    new ResizeObserver(resize).observe(canvas.parentElement);
    resize();
    home();

    const choose = (index) => {
      const from = perStage[current < 0 ? index : current];
      const to = perStage[index];
      for (const name of Object.keys(to)) {
        shape.setAttribute(`${name}From`, from[name]);
        shape.setAttribute(`${name}To`, to[name]);
      }
      uniforms.flatFrom.value = Number(scene.stages[current < 0 ? index : current].flat);
      uniforms.flatTo.value = Number(scene.stages[index].flat);
      uniforms.change.value = current < 0 || calm ? 1 : 0;
      current = index;
      dirty = true;
    };

    const legends = stage.querySelectorAll('[data-legend]');
    const actions = {
      stage: (value) => choose(scene.stages.findIndex(({ key }) => key === value)),
      colouring: (value) => {
        uniforms.colouring.value = ['picture', 'graticule', 'area', 'angle', 'plain'].indexOf(value);
        for (const legend of legends) legend.hidden = legend.dataset.legend !== value;
        dirty = true;
      },
      morph: (value) => {
        morphGoal = Number(value) / 100;
        if (calm) uniforms.morph.value = morphGoal;
        dirty = true;
      },
      wireframe: (_, checked) => {
        if (checked && !wire) wire = makeWire(shape, triangles, uniforms, defines, world);
        if (wire) wire.visible = checked;
        dirty = true;
      },
    };
    const fire = (input) => {
      const action = actions[input.name];
      if (action && (input.type !== 'radio' || input.checked)) action(input.value, input.checked);
    };
    const form = document.getElementById('viewer-controls');
    form.addEventListener('input', (event) => fire(event.target));
    // An address such as #stage=conformal&colouring=area&morph=100 opens the view in that state.
    const wanted = new URLSearchParams(location.hash.slice(1));
    for (const input of form.elements) {
      const value = wanted.get(input.name);
      if (value !== null && input.type === 'radio') input.checked = input.value === value;
      else if (value !== null && input.type === 'checkbox') input.checked = value === '1';
      else if (value !== null) input.value = value;
    }
    for (const input of form.elements) fire(input);
    uniforms.morph.value = morphGoal;

    document.getElementById('viewer-home').addEventListener('click', () => { home(); dirty = true; });
    canvas.addEventListener('keydown', (event) => {
      const step = 0.12;
      const turns = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
      const zooms = { '+': 0.9, '=': 0.9, '-': 1.1 };
      if (turns[event.key]) turnBy(...turns[event.key]);
      else if (zooms[event.key]) camera.position.multiplyScalar(zooms[event.key]);
      else return;
      controls.autoRotate = false;
      controls.update();
      dirty = true;
      event.preventDefault();
    });
    const turnBy = (azimuth, polar) => {
      const { x, y, z } = camera.position;
      const distance = Math.hypot(x, y, z);
      const theta = Math.atan2(x, z) + azimuth;
      const phi = Math.min(Math.max(Math.acos(y / distance) + polar, 0.02), Math.PI - 0.02);
      camera.position.set(
        distance * Math.sin(phi) * Math.sin(theta), distance * Math.cos(phi), distance * Math.sin(phi) * Math.cos(theta),
      );
    };
    controls.addEventListener('change', () => { dirty = true; });
    canvas.addEventListener('webglcontextlost', () => giveUp('the graphics context was lost'));

    let seen = true;
    new IntersectionObserver((entries) => { seen = entries.at(-1).isIntersecting; }).observe(stage);
    let before = performance.now();
    const frame = (now) => {
      const seconds = Math.min((now - before) / 1000, 0.1);
      before = now;
      if (uniforms.change.value < 1) {
        uniforms.change.value = Math.min(1, uniforms.change.value + seconds / 0.9);
        dirty = true;
      }
      const left = morphGoal - uniforms.morph.value;
      if (left !== 0) {
        uniforms.morph.value = Math.abs(left) < 0.002 ? morphGoal : uniforms.morph.value + left * Math.min(1, 9 * seconds);
        dirty = true;
      }
      controls.update();
      if (dirty && seen) {
        dirty = false;
        renderer.render(world, camera);
      }
      requestAnimationFrame(frame);
    };
    stage.classList.add('is-live');
    resize();
    renderer.render(world, camera);
    root.dataset.viewer = 'live';
    requestAnimationFrame(frame);
  }

  function makeWire(shape, triangles, uniforms, defines, world) {
    // Inside a surface every edge is met once in each direction: take it where its ends ascend. On the boundary some
    // are met descending only.
    const ends = new Uint32Array(2 * triangles.length);
    const count = shape.attributes.position.count;
    const met = new Set();
    let used = 0;
    for (const ascending of [true, false]) {
      for (let k = 0; k < triangles.length; k += 3) {
        for (let j = 0; j < 3; j++) {
          const a = triangles[k + j];
          const b = triangles[k + ((j + 1) % 3)];
          if ((a < b) !== ascending) continue;
          if (ascending) met.add(a * count + b);
          else if (met.has(b * count + a)) continue;
          ends[used++] = a;
          ends[used++] = b;
        }
      }
    }
    const edges = new THREE.BufferGeometry();
    // One geometry's attributes are the other's: a change of stage reaches both.
    edges.attributes = shape.attributes;
    edges.setIndex(new THREE.BufferAttribute(ends.subarray(0, used), 1));
    const material = new THREE.ShaderMaterial({
      uniforms, defines, vertexShader: VERTEX, fragmentShader: EDGE_FRAGMENT, transparent: true, depthWrite: false,
    });
    const lines = new THREE.LineSegments(edges, material);
    lines.frustumCulled = false;
    world.add(lines);
    return lines;
  }
})();
