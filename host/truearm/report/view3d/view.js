// The 3-D view of a page: the arm, fixtures, points with their error vectors, a field. Its data are the JSON of #scene
// (report/page.py), lengths in m, errors in mm. It draws when something changes, and asks nothing of the network.
import {
  AmbientLight, Box3, BufferGeometry, CapsuleGeometry, Color, ConeGeometry, CylinderGeometry, DirectionalLight, Float32BufferAttribute, Group,
  InstancedMesh, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshLambertMaterial, PerspectiveCamera, Quaternion,
  Raycaster, Scene, SphereGeometry, Spherical, Vector2, Vector3, WebGLRenderer,
} from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';

const SCALE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]; // as the picture of truearm map
const VECTOR = 0.05; // of the picture: how long the median of the first vectors is drawn
const UP = new Vector3(0, 1, 0);

const data = JSON.parse(document.getElementById('scene').textContent);
const section = document.getElementById('view3d');

function element(parent, name, attributes = {}, text = '') {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  parent.append(made);
  return made;
}

const figures = value => (value === null ? '–' : value === 0 ? '0' : Number(value.toPrecision(3)).toString());
const roundStep = rough => {
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map(factor => factor * power).find(step => step >= rough * (1 - 1e-9));
};
const quantile = (values, share) => {
  const sorted = values.filter(value => value !== null).sort((a, b) => a - b);
  return sorted.length ? sorted[Math.floor(share * (sorted.length - 1))] : 0;
};
const colourAt = share => {
  const place = Math.min(Math.max(share, 0), 1) * (SCALE.length - 1), low = Math.min(Math.floor(place), SCALE.length - 2);
  const [red, green, blue] = SCALE[low].map((value, k) => Math.round(value + (place - low) * (SCALE[low + 1][k] - value)));
  return `rgb(${red},${green},${blue})`;
};

// --- the scene

const ARM = 0, POINTS = 1; // layers: points and vectors are drawn over the arm, which would hide some
const scene = new Scene(), camera = new PerspectiveCamera(38, 1, 0.01, 100), everything = [];
camera.up.set(0, 0, 1);
const light = new AmbientLight(0xffffff, 1.7), lamp = new DirectionalLight(0xffffff, 1.6);
light.layers.enable(POINTS);
lamp.layers.enable(POINTS);
scene.add(light);
camera.add(lamp);
lamp.position.set(-1, 1, 1);
scene.add(camera);

const vector = (row, start = 0) => new Vector3(row[start], row[start + 1], row[start + 2]);
const material = (variable, more = {}) => {
  const made = new MeshLambertMaterial(more);
  made.userData.variable = variable; // a colour of page.css
  everything.push(made);
  return made;
};

function rod(parent, from, to, radius, paint) {
  const along = to.clone().sub(from), length = along.length();
  const mesh = new Mesh(length > 1e-6 ? new CapsuleGeometry(radius, length, 6, 20) : new SphereGeometry(radius, 20, 14), paint);
  mesh.position.addVectors(from, to).multiplyScalar(0.5);
  if (length > 1e-6) mesh.quaternion.setFromUnitVectors(UP, along.divideScalar(length));
  parent.add(mesh);
  return mesh;
}

// The links are given where they are with all joints at 0: a joint turns (or moves) all that follows about its axis.
const joints = [null, ...data.arm.joints], carried = joints.map(() => new Group());
carried.forEach(group => { group.matrixAutoUpdate = false; scene.add(group); });
const armPaint = material('--old'), toolPaint = material('--fit');
for (const [joint, ...row] of data.arm.links) rod(carried[joint], vector(row), vector(row, 3), row[6], armPaint);
for (const [joint, ...row] of data.arm.tools) rod(carried[joint], vector(row), vector(row, 3), row[6], toolPaint);

function moveArm(q) {
  const pose = new Matrix4(), step = new Matrix4(), back = new Matrix4();
  joints.forEach((joint, k) => {
    if (joint) {
      const [kind, ...row] = joint, axis = vector(row, 3), origin = vector(row);
      if (kind === 't') step.makeTranslation(axis.multiplyScalar(q[k - 1]));
      else step.makeTranslation(origin).multiply(back.makeRotationAxis(axis, q[k - 1])).multiply(back.makeTranslation(origin.negate()));
      pose.multiply(step);
    }
    carried[k].matrix.copy(pose);
  });
}

function corners(mesh) {
  mesh.updateWorldMatrix(true, false);
  mesh.geometry.computeBoundingBox();
  const { min, max } = mesh.geometry.boundingBox;
  return [...Array(8).keys()].map(k => new Vector3(...['x', 'y', 'z'].map((axis, bit) => (k >> bit & 1 ? max : min)[axis])).applyMatrix4(mesh.matrixWorld));
}

const fixturePaint = material('--ink');
for (const fixture of data.fixtures) {
  const place = vector(fixture.xyz), foot = place.clone().setZ(Math.min(0, place.z));
  rod(scene, place, place, fixture.post ? 0.012 : 0.004, fixturePaint);
  if (fixture.post) rod(scene, foot, place, 0.006, fixturePaint);
}
const bar = new Mesh(new CylinderGeometry(0.007, 0.007, 1, 12), fixturePaint);
bar.visible = false;
scene.add(bar);

const reach = Math.max(0.3, ...data.clouds.flatMap(cloud => cloud.points.map(point => vector(point).length())));
const floor = [], cell = roundStep(reach / 6), most = Math.ceil(reach / cell) * cell;
for (let at = -most; at <= most + 1e-9; at += cell) floor.push(-most, at, 0, most, at, 0, at, -most, 0, at, most, 0);
const lines = new LineBasicMaterial();
lines.userData.variable = '--rule';
everything.push(lines);
scene.add(new LineSegments(new BufferGeometry().setAttribute('position', new Float32BufferAttribute(floor, 3)), lines));

// --- points and their vectors

let factor = 1;
const unit = reach / 120, hidden = new Matrix4().makeScale(0, 0, 0);

class Cloud {
  constructor(given, index) {
    Object.assign(this, given);
    this.first = index === 0;
    const radius = unit * (this.first ? 1 : 0.7);
    this.dots = new InstancedMesh(new SphereGeometry(radius, 12, 8), new MeshLambertMaterial(), this.points.length);
    this.points.forEach((point, k) => this.dots.setMatrixAt(k, new Matrix4().makeTranslation(...point)));
    this.dots.visible = this.first;
    this.dots.layers.set(POINTS);
    this.needles = this.vectors.map(set => {
      const mesh = new InstancedMesh(new ConeGeometry(0.55 * unit, 1, 8).translate(0, 0.5, 0), material(`--${set.colour}`), this.points.length);
      mesh.frustumCulled = false;
      mesh.layers.set(POINTS);
      scene.add(mesh);
      return mesh;
    });
    scene.add(this.dots);
  }

  tips() {
    const ends = this.points.map(point => vector(point));
    this.vectors.forEach(set => set.mm.forEach((mm, k) => mm && ends.push(vector(this.points[k]).addScaledVector(vector(mm), 1e-3 * factor))));
    return ends;
  }

  stretch() {
    const turn = new Quaternion(), along = new Vector3(), size = new Vector3();
    this.vectors.forEach((set, s) => set.mm.forEach((mm, k) => {
      const length = mm && vector(mm).length() * 1e-3 * factor;
      if (!length) return this.needles[s].setMatrixAt(k, hidden);
      turn.setFromUnitVectors(UP, along.copy(vector(mm)).normalize());
      this.needles[s].setMatrixAt(k, new Matrix4().compose(vector(this.points[k]), turn, size.set(1, length, 1)));
    }));
    this.needles.forEach(mesh => { mesh.instanceMatrix.needsUpdate = true; });
  }

  paint(name, low, top) {
    const values = this.values.find(entry => entry.name === name), grey = new Color(css('--old'));
    this.points.forEach((_, k) => {
      const mm = values ? values.mm[k] : null;
      this.dots.setColorAt(k, mm === null ? grey : new Color(colourAt((mm - low) / (top - low))));
    });
    this.dots.instanceColor.needsUpdate = true;
  }

  describe(k) {
    const place = this.points[k].map(metres => (1e3 * metres).toFixed(0)).join(', ');
    const values = this.values.map(entry => `${entry.name} ${figures(entry.mm[k])} mm`);
    return `${this.labels[k]}: ${values.join('; ')}; at ${place} mm`;
  }
}

// --- the page

const css = variable => getComputedStyle(document.documentElement).getPropertyValue(variable).trim();
const stage = element(section, 'div', { class: 'stage' });
const canvas = element(stage, 'canvas', { tabindex: '0', role: 'img' });
let renderer = null;
try {
  renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  renderer.autoClear = false;
} catch {
  stage.remove(); // no WebGL here: the section stays hidden, and the pictures below show the same numbers
}

function show() {
  section.hidden = false;
  const clouds = data.clouds.map((given, index) => new Cloud(given, index)), [main] = clouds;
  const readout = element(section, 'output', { class: 'readout', 'aria-live': 'polite' });
  const controls = element(section, 'div', { class: 'controls' });
  const names = [...new Set(clouds.flatMap(cloud => cloud.values.map(entry => entry.name)))];
  const orbit = new OrbitControls(camera, canvas);
  const draw = () => {
    renderer.clearColor();
    for (const layer of [ARM, POINTS]) {
      renderer.clearDepth();
      camera.layers.set(layer);
      renderer.render(scene, camera);
    }
  };
  // Until the view is clicked, the wheel scrolls the page.
  orbit.enableZoom = false;
  canvas.addEventListener('focus', () => { orbit.enableZoom = true; });
  canvas.addEventListener('blur', () => { orbit.enableZoom = false; });
  let selected = 0;

  const check = (text, isOn, change, colour) => {
    const label = element(controls, 'label');
    const box = element(label, 'input', { type: 'checkbox' });
    box.checked = isOn;
    if (colour) element(label, 'i', { style: `background:var(${colour})` });
    element(label, 'span', {}, text);
    box.addEventListener('change', () => { change(box.checked); draw(); });
  };
  const slider = (text, least, greatest, value, change) => {
    const label = element(controls, 'label', { class: 'slider' });
    const name = element(label, 'span', {}, text);
    const range = element(label, 'input', { type: 'range', min: least, max: greatest, step: 1, value });
    range.addEventListener('input', () => { change(Number(range.value), name); draw(); });
    return { range, name };
  };

  // The errors' colours: one scale for all points, from the 2nd to the 98th percentile.
  const legend = element(section, 'div', { class: 'scale' });
  const select = names.length > 1 ? element(legend, 'select', { 'aria-label': 'Colour of the points' }) : null;
  if (select) names.forEach(name => element(select, 'option', { value: name }, name));
  else element(legend, 'span', {}, names[0] ?? '');
  const ends = element(legend, 'span', { class: 'ends' }), least = element(ends, 'span');
  const colours = element(ends, 'i', { style: `background:linear-gradient(to right,${SCALE.map(colour => `rgb(${colour})`)})` });
  const greatest = element(ends, 'span');
  const colour = () => {
    const name = select ? select.value : names[0];
    const all = clouds.flatMap(cloud => cloud.values.filter(entry => entry.name === name).flatMap(entry => entry.mm));
    const low = quantile(all, 0.02), top = quantile(all, 0.98), isRange = figures(low) !== figures(top);
    clouds.forEach(cloud => cloud.paint(name, low, isRange ? top : Infinity));
    colours.hidden = !isRange;
    least.textContent = isRange ? figures(low) : '';
    greatest.textContent = `${figures(top)} mm`;
    draw();
  };
  select?.addEventListener('change', colour);

  const choose = k => {
    selected = (k + main.points.length) % main.points.length;
    moveArm(main.q[selected]);
    const fixture = data.fixtures[main.fixture[selected] ?? -1];
    bar.visible = Boolean(fixture);
    if (fixture) {
      const from = vector(fixture.xyz), along = vector(main.points[selected]).sub(from), length = along.length();
      bar.scale.set(1, length, 1);
      bar.quaternion.setFromUnitVectors(UP, along.clone().divideScalar(length));
      bar.position.copy(from).addScaledVector(along, 0.5);
    }
    canvas.dataset.tool = data.arm.tools.map(([joint, ...row]) => vector(row, 3).applyMatrix4(carried[joint].matrix).toArray());
    readout.textContent = main.describe(selected);
    if (poses) {
      poses.range.value = selected + 1;
      poses.name.textContent = `${main.name}: ${selected + 1} of ${main.points.length}`;
    }
    draw();
  };

  const sizes = main.vectors.length ? main.vectors[0].mm.map(mm => mm && vector(mm).length()) : [];
  factor = roundStep(VECTOR * reach / Math.max(1e-3 * quantile(sizes, 0.5), 1e-7));
  const steps = [...Array(16).keys()].map(k => [1, 2, 5][k % 3] * 10 ** Math.floor(k / 3));
  const start = Math.max(0, steps.findIndex(step => step >= factor));
  const enlarge = (k, name) => {
    factor = steps[k];
    name.textContent = `vectors × ${factor}`;
    clouds.forEach(cloud => cloud.stretch());
  };
  const poses = main.points.length > 1 ? slider('', 1, main.points.length, 1, k => choose(k - 1)) : null;
  if (main.vectors.length) {
    const scaling = slider('', 0, steps.length - 1, start, enlarge);
    enlarge(start, scaling.name);
  }
  clouds.forEach(cloud => {
    cloud.vectors.forEach((set, s) => check(`vectors: ${set.name}`, true, on => { cloud.needles[s].visible = on; }, `--${set.colour}`));
    if (clouds.length > 1) check(cloud.name, cloud.dots.visible, on => { cloud.dots.visible = on; });
  });
  check('arm', true, on => carried.forEach(group => { group.visible = on; }));

  const nearest = new Raycaster();
  nearest.layers.set(POINTS);
  const pointer = new Vector2();
  const under = event => {
    const box = canvas.getBoundingClientRect();
    pointer.set(2 * (event.clientX - box.left) / box.width - 1, 1 - 2 * (event.clientY - box.top) / box.height);
    nearest.setFromCamera(pointer, camera);
    const hits = clouds.filter(cloud => cloud.dots.visible).flatMap(cloud => nearest.intersectObject(cloud.dots).map(hit => ({ cloud, ...hit })));
    return hits.sort((a, b) => a.distance - b.distance)[0];
  };
  canvas.addEventListener('pointermove', event => {
    const hit = under(event);
    readout.textContent = hit ? hit.cloud.describe(hit.instanceId) : main.describe(selected);
  });
  canvas.addEventListener('click', event => {
    const hit = under(event);
    if (hit && hit.cloud === main) choose(hit.instanceId);
  });

  const turn = (across, up, zoom = 1) => {
    const offset = camera.position.clone().sub(orbit.target).applyQuaternion(new Quaternion().setFromUnitVectors(camera.up, UP));
    const sphere = new Spherical().setFromVector3(offset);
    sphere.theta += across;
    sphere.phi += up;
    sphere.radius *= zoom;
    offset.setFromSpherical(sphere.makeSafe()).applyQuaternion(new Quaternion().setFromUnitVectors(UP, camera.up));
    camera.position.copy(orbit.target).add(offset);
    orbit.update();
  };
  const keys = {
    ArrowLeft: () => turn(-0.15, 0), ArrowRight: () => turn(0.15, 0), ArrowUp: () => turn(0, -0.15), ArrowDown: () => turn(0, 0.15),
    '+': () => turn(0, 0, 1 / 1.15), '-': () => turn(0, 0, 1.15), Home: () => orbit.reset(),
    ',': () => choose(selected - 1), '.': () => choose(selected + 1),
  };
  canvas.addEventListener('keydown', event => {
    if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    isTurned = event.key !== 'Home' && (isTurned || !',.'.includes(event.key));
    keys[event.key]();
    draw();
  });
  const words = 'Drag or use the arrow keys to turn, + and − (after a click, also the wheel) to zoom, comma and full stop for the point before and after.';
  canvas.setAttribute('aria-label', `${data.title}. ${words}`);
  element(section, 'p', { class: 'small' }, `${data.caption} ${words}`);

  const restyle = () => {
    renderer.setClearColor(new Color(css('--card')));
    everything.forEach(paint => paint.color.set(css(paint.userData.variable)));
    colour();
  };
  // From the side of the points and above, with all of the arm, of the points and of their vectors in sight.
  let isTurned = false;
  const frame = () => {
    const sights = clouds.flatMap(cloud => cloud.tips()), box = new Box3().setFromPoints(sights);
    const middle = box.getCenter(new Vector3()), away = Math.atan2(middle.y, middle.x) - 0.9;
    carried.forEach(group => group.traverse(link => link.isMesh && sights.push(...corners(link))));
    box.setFromPoints(sights).getCenter(orbit.target);
    const towards = new Vector3(Math.cos(away), Math.sin(away), 0.5).normalize(), steep = Math.tan(camera.fov * Math.PI / 360);
    camera.position.copy(orbit.target).add(towards);
    camera.lookAt(orbit.target);
    const back = camera.quaternion.clone().invert();
    const distances = sights.map(end => end.sub(orbit.target).applyQuaternion(back)).map(({ x, y, z }) => z + Math.max(Math.abs(x) / camera.aspect, Math.abs(y)) / steep);
    camera.position.copy(orbit.target).addScaledVector(towards, 1.05 * Math.max(...distances));
    orbit.update();
    orbit.saveState();
  };
  const resize = () => {
    const { clientWidth: width, clientHeight: height } = stage;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.fov = width < height ? 55 : 38;
    camera.updateProjectionMatrix();
    if (!isTurned) frame();
    draw();
  };
  orbit.addEventListener('start', () => { isTurned = true; });
  choose(0);
  resize();
  orbit.addEventListener('change', draw);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', restyle);
  new ResizeObserver(resize).observe(stage);
  restyle();
}
if (renderer) show();
