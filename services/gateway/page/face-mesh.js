// Finds the face in images with MediaPipe's face mesh, in a separate frame (face-mesh.html).
// Images arrive as messages, landmarks are sent back. It runs on the CPU, so that all browsers
// compute the same landmarks.

const { FaceMesh, FACEMESH_LIPS } = window; // from modules/face_mesh/face_mesh.js

function answer(message) {
  parent.postMessage(message, location.origin);
}

const mesh = new FaceMesh({ locateFile: (name) => `modules/face_mesh/${name}` });
mesh.setOptions({ maxNumFaces: 1, useCpuInference: true });
mesh.onResults(({ image, multiFaceLandmarks: [face] }) => {
  const { width, height } = image;
  const pixels = face?.flatMap(({ x, y, z }) => [x * width, y * height, z * width]);
  answer({ landmarks: pixels ? Float32Array.from(pixels) : null });
});

addEventListener("message", async ({ data: image, origin }) => {
  if (origin !== location.origin) return;
  try {
    await mesh.send({ image });
  } catch (error) {
    answer({ problem: error.message });
  } finally {
    image.close();
  }
});

try {
  await mesh.initialize();
  answer({ lips: FACEMESH_LIPS });
} catch (error) {
  answer({ problem: error.message });
}
