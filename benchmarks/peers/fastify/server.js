// Fastify over onnxruntime-node on one thread: node server.js PORT POLICY.onnx

const fastify = require("fastify")();
const ort = require("onnxruntime-node");

async function main(port, file) {
  const session = await ort.InferenceSession.create(file, { intraOpNumThreads: 1, interOpNumThreads: 1 });
  fastify.post("/act", async (request) => {
    const obs = Float32Array.from(request.body.obs);
    const outputs = await session.run({ obs: new ort.Tensor("float32", obs, [1, obs.length]) });
    return { action: Array.from(outputs.action.data) };
  });
  await fastify.listen({ host: "127.0.0.1", port });
}

main(Number(process.argv[2]), process.argv[3]);
