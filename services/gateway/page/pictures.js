// Pictures one after another: each is begun when the one before is done, and told when it is seen.

const LOOK_EVERY_MS = 2; // whether a picture is done
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

/** Say whether the processor draws, and not a graphics card. */
export function drawsInSoftware(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return SOFTWARE.test(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}

export class Pictures {
  numDrawn = 0;
  #gl;
  #pace;
  #isDrawing = false;

  /** @param gl a WebGL 2 context; @param pace says how often it is drawn to */
  constructor(gl, pace) {
    this.#gl = gl;
    this.#pace = pace;
  }

  /**
   * Whether it is time for a picture, and the one before is done: a slow machine is to have fewer
   * pictures rather than a queue of late ones that block the page.
   */
  isDue(nowMs) {
    return !this.#isDrawing && this.#pace.isDue(nowMs);
  }

  /**
   * Draw one.
   *
   * @param nowMs the time that its face is of; @param render draws it; @param seen called with when
   *   it is seen first, ms
   */
  draw(nowMs, render, seen = () => {}) {
    this.#isDrawing = true;
    const begunMs = performance.now();
    render();
    this.#whenDone(() => {
      this.#isDrawing = false;
      this.numDrawn++;
      const doneMs = performance.now();
      this.#pace.drew(begunMs, doneMs);
      requestAnimationFrame((tickMs) => {
        const seenMs = Math.max(tickMs, doneMs); // a busy page hears of a tick after it
        this.#pace.saw(nowMs, seenMs);
        seen(seenMs);
      });
    });
  }

  #whenDone(act) {
    const gl = this.#gl;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      if (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) {
        setTimeout(look, LOOK_EVERY_MS);
      } else {
        gl.deleteSync(fence);
        act();
      }
    };
    setTimeout(look);
  }
}
