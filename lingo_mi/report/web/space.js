// The cloud, surfaces of the volume, and the scanner around them, in 3D (drawn by three.js, only when something has changed).

class Space {
  constructor(root, known, arrays, maps) {
    Object.assign(this, { root, known, maps, shownAs: {} });
    this.bar = element('div', { class: 'bar' });
    this.stage = element('div', { class: 'stage', tabindex: 0, role: 'application', 'aria-roledescription': '3D scene' });
    this.stage.setAttribute('aria-label', 'Gaussians, surfaces and scanner in 3D; arrow keys turn, plus and minus zoom');
    this.note = text('p', '', { class: 'note' });
    root.replaceChildren(this.bar, this.stage, this.note);
    this.draw = onceAFrame(() => this.paint());
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(35, 1, 1, 1e6);
    this.camera.up.set(0, 0, 1);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x556070, 2.2), this.camera);
    const light = new THREE.DirectionalLight(0xffffff, 1.6);
    light.position.set(-1, 1, 2);
    this.camera.add(light);
    this.controls = new THREE.OrbitControls(this.camera, this.stage);
    this.controls.addEventListener('change', () => this.move());
    this.fill(arrays);
    this.listen();
    this.look();
    new ResizeObserver(this.draw).observe(this.stage);
    // WebGL starts when the scene comes into sight: without a GPU that takes a second or more.
    new IntersectionObserver((found) => {
      this.seen = found[found.length - 1].isIntersecting;
      this.draw();
    }, { rootMargin: '200px' }).observe(this.stage);
  }

  replace(known, arrays) {
    this.known = known;
    this.fill(arrays);
  }

  fill(arrays) {
    const { known } = this;
    for (const part of this.parts ? Object.values(this.parts) : []) {
      this.scene.remove(part);
      part.geometry.dispose();
      part.material.dispose();
      part.dispose?.();
    }
    this.parts = {};
    this.said = [];
    if (known.cloud) this.addCloud(known.cloud, arrays);
    (known.surfaces || []).forEach((s, i) => this.addSurface(s, arrays, i));
    if (known.scanner) this.addScanner(known.scanner);
    this.parts.Volume = lines(boxEdges(known.low, known.high), 0x8fa0b5);
    const start = { Points: true, Volume: true, Scanner: false };
    if (!known.cloud && (known.surfaces || []).length) start[known.surfaces[0].name] = true;
    for (const [name, part] of Object.entries(this.parts)) {
      part.visible = this.shownAs[name] ?? start[name] ?? false;
      this.make(part);
      this.scene.add(part);
    }
    const names = Object.keys(this.parts);
    if (names.join() !== [...this.bar.children].map((b) => b.textContent).join()) {
      this.bar.replaceChildren(...names.map((name) => button(name, this.parts[name].visible, (made) => this.toggle(name, made))));
    }
    if (!this.failed) this.note.textContent = this.said.join(' ');
    this.draw();
  }

  addCloud(cloud, arrays) {
    const count = cloud.count;
    const { centres, densities, scales, quaternions } = arrays;
    const place = new Float32Array(3 * count);
    const colour = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      const share = Math.min(255, Math.max(0, Math.floor((valueAt(densities, i) / cloud.top) * 256)));
      const pixel = this.maps.cloud[share];
      const made = new THREE.Color().setRGB((pixel & 255) / 255, ((pixel >> 8) & 255) / 255, ((pixel >> 16) & 255) / 255, 'srgb');
      made.toArray(colour, 3 * i);
      for (let axis = 0; axis < 3; axis++) place[3 * i + axis] = valueAt(centres, i + count * axis);
    }
    const shape = new THREE.BufferGeometry();
    shape.setAttribute('position', new THREE.BufferAttribute(place, 3));
    shape.setAttribute('color', new THREE.BufferAttribute(colour, 3));
    this.parts.Points = new THREE.Points(shape, new THREE.PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true }));
    if (cloud.ellipsoids) {
      const many = new THREE.InstancedMesh(new THREE.IcosahedronGeometry(1, 1), new THREE.MeshLambertMaterial(), count);
      many.userData.make = () => {
        if (this.software && count > 10_000) many.geometry = new THREE.IcosahedronGeometry(1, 0);
        placeEllipsoids(many, place, colour, scales, quaternions);
      };
      this.parts.Ellipsoids = many;
    }
    const some = cloud.total > count ? `${count.toLocaleString('en')} of ${cloud.total.toLocaleString('en')} Gaussians, chosen at random` : `${count.toLocaleString('en')} Gaussians`;
    this.said.push(`${some}, coloured by ${cloud.unit} from 0 (dark) to ${shown(cloud.top, cloud.top / 1000)} (bright); ellipsoids are one standard deviation.`);
  }

  toggle(name, made) {
    const part = this.parts[name];
    part.visible = this.shownAs[name] = !part.visible;
    this.make(part);
    made.setAttribute('aria-pressed', String(part.visible));
    if (name === 'Scanner') this.look();
    this.draw();
  }

  // What is not made before it is seen.
  make(part) {
    if (!part.visible || !part.userData.make) return;
    part.userData.make();
    delete part.userData.make;
  }

  addSurface(surface, arrays, i) {
    const points = arrays[`${surface.array}points`];
    const faces = arrays[`${surface.array}faces`];
    const [count, triangles] = [points.shape[0], faces.shape[0]];
    const place = new Float32Array(3 * count);
    const index = new Uint32Array(3 * triangles);
    for (let n = 0; n < count; n++) for (let a = 0; a < 3; a++) place[3 * n + a] = valueAt(points, n + count * a);
    for (let n = 0; n < triangles; n++) for (let a = 0; a < 3; a++) index[3 * n + a] = faces.codes[n + triangles * a];
    const shape = new THREE.BufferGeometry();
    shape.setAttribute('position', new THREE.BufferAttribute(place, 3));
    shape.setIndex(new THREE.BufferAttribute(index, 1));
    shape.computeVertexNormals();
    const look = { color: [0xb9c6d6, 0xf0dcb8][i], side: THREE.DoubleSide, transparent: i === 0, opacity: i === 0 ? 0.45 : 1, depthWrite: i > 0 };
    this.parts[surface.name] = new THREE.Mesh(shape, new THREE.MeshLambertMaterial(look));
    this.said.push(`${surface.name}: density ${shown(surface.level, surface.level / 1000)}${surface.unit}.`);
  }

  addScanner(scanner) {
    const ends = [];
    const n = scanner.sources.length;
    const size = Math.hypot(...this.known.high.map((h, i) => h - this.known.low[i])) / 60;
    scanner.sources.forEach((s, i) => {
      for (let a = 0; a < 3; a++) ends.push(s.map((x, k) => x - (k === a ? size : 0)), s.map((x, k) => x + (k === a ? size : 0)));
      if (i !== 0 && i !== Math.floor(n / 3)) return;
      const corners = scanner.panels[i];
      corners.forEach((c, k) => ends.push(c, corners[(k + 1) % 4]));
      if (!scanner.parallel) corners.forEach((c) => ends.push(s, c));
    });
    this.parts.Scanner = lines(ends.flat(), 0x63b58a);
    this.said.push(`Scanner: ${n} ${scanner.parallel ? 'directions of the beam' : 'positions of the source'} (crosses), and the panel of two views.`);
  }

  look() {
    const { low, high, scanner } = this.known;
    const ends = [low, high];
    if (this.parts.Scanner?.visible) ends.push(...scanner.sources, ...scanner.panels[0], ...scanner.panels[Math.floor(scanner.panels.length / 3)]);
    const least = [0, 1, 2].map((i) => Math.min(...ends.map((e) => e[i])));
    const most = [0, 1, 2].map((i) => Math.max(...ends.map((e) => e[i])));
    const middle = least.map((l, i) => (l + most[i]) / 2);
    const radius = (Math.hypot(...most.map((m, i) => m - least[i])) / 2) * (this.parts.Scanner?.visible ? 0.75 : 1);
    const distance = (radius / Math.sin((17.5 * Math.PI) / 180)) * 0.95;
    this.controls.target.set(...middle);
    this.camera.position.set(middle[0] + distance * 0.62, middle[1] - distance * 0.7, middle[2] + distance * 0.35);
    Object.assign(this.camera, { near: distance / 100, far: distance * 10 });
    this.camera.updateProjectionMatrix();
    this.controls.update();
  }

  listen() {
    this.stage.addEventListener('keydown', (event) => {
      const turn = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, -0.12], ArrowDown: [0, 0.12] }[event.key];
      const zoom = { '+': 0.85, '=': 0.85, '-': 1 / 0.85 }[event.key];
      if (event.ctrlKey || event.altKey || event.metaKey || !(turn || zoom || event.key === '0')) return;
      event.preventDefault();
      const from = this.camera.position.clone().sub(this.controls.target);
      if (event.key === '0') return this.look();
      if (zoom) from.multiplyScalar(zoom);
      else {
        from.applyAxisAngle(this.camera.up, turn[0]);
        const polar = Math.min(3.0, Math.max(0.14, Math.acos(from.z / from.length()) + turn[1]));
        const flat = Math.hypot(from.x, from.y) || 1;
        const length = from.length();
        const across = (length * Math.sin(polar)) / flat;
        from.set(from.x * across, from.y * across, length * Math.cos(polar));
      }
      this.camera.position.copy(this.controls.target).add(from);
      this.controls.update();
      this.draw();
    });
  }

  paint() {
    if (this.failed) return;
    const width = Math.max(1, this.stage.clientWidth);
    const height = Math.max(1, Math.round(Math.min(width * 0.8, 620)));
    this.stage.style.height = `${height}px`;
    if (!this.seen || !this.start()) return;
    const coarse = this.software && this.moving;
    const ratio = Math.min(2, window.devicePixelRatio || 1) * (coarse ? 0.5 : 1);
    if (this.width !== width || this.ratio !== ratio) {
      Object.assign(this, { width, ratio });
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height);
      this.camera.aspect = width / height;
      this.camera.updateProjectionMatrix();
    }
    this.renderer.setClearColor(new THREE.Color(colourOf('--stage')));
    const { Points, Ellipsoids } = this.parts;
    const shown = [Points?.visible, Ellipsoids?.visible];
    if (coarse && Ellipsoids?.visible) [Points.visible, Ellipsoids.visible] = [true, false];
    this.renderer.render(this.scene, this.camera);
    if (Ellipsoids) [Points.visible, Ellipsoids.visible] = shown;
  }

  // Without a GPU, what turns is drawn with half as many pixels a side, and ellipsoids as points; all of it when it stands still.
  move() {
    this.moving = true;
    clearTimeout(this.still);
    this.still = setTimeout(() => {
      this.moving = false;
      this.draw();
    }, 200);
    this.draw();
  }

  // Whether there is WebGL.
  start() {
    if (this.renderer) return true;
    try {
      this.renderer = new THREE.WebGLRenderer({ antialias: true });
    } catch {
      this.failed = true;
      this.bar.remove();
      this.stage.remove();
      this.note.textContent = 'This browser has no WebGL, so that the cloud cannot be shown in 3D.';
      return false;
    }
    const gl = this.renderer.getContext();
    const info = gl.getExtension('WEBGL_debug_renderer_info');
    this.software = Boolean(info) && /swiftshader|llvmpipe|software|basic render/i.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
    this.stage.append(this.renderer.domElement);
    this.renderer.domElement.setAttribute('aria-hidden', 'true');
    return true;
  }
}

function placeEllipsoids(many, place, colour, scales, quaternions) {
  const { count } = many;
  const matrix = new THREE.Matrix4();
  for (let i = 0; i < count; i++) {
    const at = (array, n) => Array.from({ length: n }, (_, k) => valueAt(array, i + count * k));
    const size = at(scales, 3).map(Math.exp);
    matrix.compose(new THREE.Vector3().fromArray(place, 3 * i), new THREE.Quaternion(...at(quaternions, 4)).normalize(), new THREE.Vector3(...size));
    many.setMatrixAt(i, matrix);
    many.setColorAt(i, new THREE.Color().fromArray(colour, 3 * i));
  }
}

function lines(ends, colour) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute('position', new THREE.BufferAttribute(new Float32Array(ends), 3));
  return new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: colour }));
}

function boxEdges(low, high) {
  const out = [];
  for (let axis = 0; axis < 3; axis++) {
    for (const [b, c] of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
      for (const end of [0, 1]) {
        const corner = [0, 0, 0];
        corner[axis] = end;
        corner[(axis + 1) % 3] = b;
        corner[(axis + 2) % 3] = c;
        out.push(...corner.map((e, i) => (e ? high[i] : low[i])));
      }
    }
  }
  return out;
}
