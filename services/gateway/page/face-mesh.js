// Finds the face in pictures, in a frame of its own (face-mesh.html): pictures come as messages,
// landmarks go back. MediaPipe's face mesh, on the CPU, which every browser computes alike.

const { FaceMesh, FACEMESH_LIPS } = window; // of modules/face_mesh/face_mesh.js

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

addEventListener("message", async ({ data: picture, origin }) => {
  if (origin !== location.origin) return;
  try {
    await mesh.send({ image: picture });
  } catch (error) {
    answer({ problem: error.message });
  } finally {
    picture.close();
  }
});

try {
  await mesh.initialize();
  answer({ lips: FACEMESH_LIPS });
} catch (error) {
  answer({ problem: error.message });
}
