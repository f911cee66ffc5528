// The source code of the light is loaded with the head. Materials are made without a graphics card.

import assert from "node:assert/strict";
import test from "node:test";
import { loadLight, plainMaterial } from "../../services/gateway/page/materials.js";

test("an error page is not used as the source code of the light", async () => {
  globalThis.fetch = async () => new Response("not found", { status: 404, statusText: "Not Found" });
  await assert.rejects(loadLight(), /light\.glsl: 404 Not Found/);
  globalThis.fetch = async () => new Response("float light;");
  await loadLight();
  const material = plainMaterial("skin", { map: {}, userData: {} }, { matrixWorld: null }, false);
  assert.ok(material.vertexShader.startsWith("float light;"));
  assert.ok(material.fragmentShader.startsWith("float light;"));
});
