// Draws images one after another. The next image starts when the last one is done.

const POLL_MS = 2; // interval of checking whether an image is done
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** Return whether the processor draws instead of a graphics card. */
export function drawsInSoftware(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return SOFTWARE.test(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}

export class ImageQueue {
  numDrawn = 0;
  #gl;
  #drawRate;
  #isDrawing = false;

  /** @param gl a WebGL 2 context; @param {DrawRate} drawRate decides how often to draw */
  constructor(gl, drawRate) {
    this.#gl = gl;
    this.#drawRate = drawRate;
  }

  /**
   * Whether it is time for an image and the last one is done. A slow machine must draw fewer images
   * instead of a queue of late ones that block the page.
   */
  isDue(nowMs) {
    return !this.#isDrawing && this.#drawRate.isDue(nowMs);
  }

  /**
   * Draw an image.
   *
   * @param nowMs time of its face
   * @param render function that draws it
   * @param onVisible called with the time at which it becomes visible, ms
   */
  draw(nowMs, render, onVisible = () => {}) {
    this.#isDrawing = true;
    const startMs = performance.now();
    render();
    this.#whenDone(() => {
      this.#isDrawing = false;
      this.numDrawn++;
      const doneMs = performance.now();
      this.#drawRate.recordDrawn(startMs, doneMs);
      requestAnimationFrame((tickMs) => {
        const visibleMs = Math.max(tickMs, doneMs); // a busy page gets a tick late
        this.#drawRate.recordVisible(nowMs, visibleMs);
        onVisible(visibleMs);
      });
    });
  }

  #whenDone(callback) {
    const gl = this.#gl;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const poll = () => {
      if (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) {
        setTimeout(poll, POLL_MS);
      } else {
        gl.deleteSync(fence);
        callback();
      }
    };
    setTimeout(poll);
  }
}
