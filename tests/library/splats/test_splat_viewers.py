"""Files of splats in a browser: Spark (three.js, WebGL) draws the picture that is drawn here, and SPZ's own reader has
the same values.

They are skipped where there are no such packages: npm install -g three @sparkjsdev/spark @spz-loader/core (0.187, 2.2.0
and 0.3.1 were tried).
"""

import base64
import functools
import pathlib
import shutil
import subprocess
import threading
import time
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import imageio.v3 as iio
import numpy as np
import pytest
from page_probe import chromium
from scipy.spatial.transform import Rotation
from splat_scenes import SH_0, place, place_camera, some_splats

import warpcage

PACKAGES = ("three", "@sparkjsdev/spark", "@spz-loader/core")

PAGE = """<!doctype html><meta charset="utf-8">
<script type="importmap">{"imports": {
  "three": "/packages/three/build/three.module.js", "three/addons/": "/packages/three/examples/jsm/",
  "spark": "/packages/@sparkjsdev/spark/dist/spark.module.js", "spz": "/packages/@spz-loader/core/dist/index.js"
}}</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "spark";
import { loadSpz } from "spz";
const work = {
  async draw(file, { width, height, matrix, projection }) {
    const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
    renderer.setPixelRatio(1);
    renderer.setSize(width, height);
    renderer.setClearColor(0xffffff, 1);
    const scene = new THREE.Scene();
    const mesh = new SplatMesh({ url: file, extSplats: true });
    await mesh.initialized;
    const plain = { preBlurAmount: 0.3, blurAmount: 0 }; // files that were fitted without antialiasing
    scene.add(new SparkRenderer({ renderer, maxStdDev: 3, ...plain }), mesh);
    const camera = new THREE.Camera();
    camera.matrixAutoUpdate = false;
    camera.matrix.fromArray(matrix);
    camera.projectionMatrix.fromArray(projection);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    camera.updateMatrixWorld(true);
    for (let i = 0; i < 4; i++) { // splats are sorted beside the pictures
      renderer.render(scene, camera);
      await new Promise((resolve) => setTimeout(resolve, 500));
    }
    return renderer.domElement.toDataURL("image/png");
  },
  async read(file) {
    const bytes = new Uint8Array(await (await fetch(file)).arrayBuffer());
    const cloud = await loadSpz(bytes, { unpackOptions: { coordinateSystem: "RDF" } });
    return Object.fromEntries(Object.entries(cloud).map(([name, value]) => [name, value.length ? [...value] : value]));
  },
};
window.begin = (name, ...given) => {
  window.result = null;
  const failed = (error) => (window.result = { error: String(error) });
  work[name](...given).then((value) => (window.result = { value }), failed);
};
</script>
"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


class Page:
    """The packages in a browser, and a folder of files that they can read."""

    def __init__(self, driver, folder):
        self.driver, self.folder = driver, folder

    def call(self, name, *given, patience=240.0):
        """What one of the page's functions gives."""
        end = time.monotonic() + patience
        while not self.driver.execute_script("return Boolean(window.begin)"):
            assert time.monotonic() < end, self.driver.get_log("browser")
            time.sleep(0.1)
        self.driver.execute_script("window.begin(...arguments)", name, *given)
        while not (result := self.driver.execute_script("return window.result")):
            assert time.monotonic() < end, self.driver.get_log("browser")
            time.sleep(0.2)
        assert "error" not in result, result
        return result["value"]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    npm = shutil.which("npm")
    root = npm and pathlib.Path(subprocess.run([npm, "root", "-g"], capture_output=True, text=True).stdout.strip())
    missing = [each for each in PACKAGES if not root or not (root / each).is_dir()]
    if missing:
        pytest.skip(f"packages of npm that are not installed: {' '.join(missing)}")
    folder = tmp_path_factory.mktemp("viewer")
    (folder / "packages").symlink_to(root)
    (folder / "page.html").write_text(PAGE)
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with chromium(400, 300, webgl=True) as driver:
            driver.get(f"http://127.0.0.1:{server.server_port}/page.html")
            yield Page(driver, folder)
    finally:
        server.shutdown()
        server.server_close()


def view(camera, turned, near=0.05, far=50.0):
    """A camera as three.js has it; turned: whether the file's world has y up and z to the back."""
    width, height = camera.width, camera.height
    projection = np.zeros((4, 4))
    projection[0, :3] = 2 * camera.fx / width, 0, 1 - 2 * camera.cx / width
    projection[1, 1:3] = 2 * camera.fy / height, 2 * camera.cy / height - 1
    projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = -1
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix = camera.camera_to_world @ half_turn
    matrix = half_turn @ matrix if turned else matrix
    columns = {"matrix": matrix.T.ravel().tolist(), "projection": projection.T.ravel().tolist()}
    return {"width": width, "height": height, **columns}


@pytest.mark.parametrize("ending", [".ply", ".compressed.ply", ".splat", ".spz", ".sog"])
def test_a_viewer_on_the_web_draws_the_same_picture(page, ending):
    field, _ = place()
    field.save(page.folder / f"place{ending}")
    camera = place_camera(size=200)
    drawn = page.call("draw", f"/place{ending}", view(camera, turned=ending == ".spz"))
    theirs = iio.imread(base64.b64decode(drawn.split(",")[1]))[..., :3] / 255
    same = warpcage.SplatField.load(page.folder / f"place{ending}", device="cpu")
    ours = same.render(camera, background="white").rgb.clip(0, 1)
    assert ours.std() > 0.1  # there is something to see
    psnr = -10 * np.log10(np.mean((ours - theirs) ** 2))
    assert psnr > 43, f"{psnr:.1f} dB"


def test_the_reader_of_the_format_s_authors_has_the_same_values(page):
    field = warpcage.SplatField.from_contents(some_splats(300, antialias=True), device="cpu")
    field.save(page.folder / "some.spz")
    cloud = page.call("read", "/some.spz")
    same = warpcage.SplatField.load(page.folder / "some.spz", device="cpu")
    assert (cloud["numPoints"], cloud["shDegree"], cloud["antialiased"]) == (300, 3, True)
    values = {name: np.reshape(cloud[name], (300, -1)) for name in ("positions", "scales", "alphas", "colors", "sh")}
    np.testing.assert_allclose(values["positions"], same.contents.centers, atol=1e-6)
    np.testing.assert_allclose(values["scales"], same.scales, rtol=1e-5)
    np.testing.assert_allclose(values["alphas"][:, 0], same.opacities, atol=1e-5)
    np.testing.assert_allclose(values["colors"], 0.5 + SH_0 * same.contents.harmonics[:, 0], atol=1e-4)  # it has 0.282
    np.testing.assert_allclose(values["sh"], same.contents.harmonics[:, 1:].reshape(300, -1), atol=1e-5)
    turns = Rotation.from_quat(np.reshape(cloud["rotations"], (300, 4))).as_matrix()
    shapes = np.einsum("nij,nj,nkj->nik", turns, values["scales"] ** 2, turns)
    np.testing.assert_allclose(shapes, same.covariances, atol=1e-6)
