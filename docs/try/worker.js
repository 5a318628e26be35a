// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
// Python in a thread of its own, so that the page stays alive. Everything comes from this site.
const HERE = new URL('python/', self.location.href).href;

function tell(kind, text) {
  self.postMessage({ kind, text });
}

async function fetched(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: ${answer.status}`);
  return answer;
}

async function start() {
  self.importScripts(`${HERE}pyodide.js`);
  const python = await self.loadPyodide({
    indexURL: HERE, packages: ['numpy', 'scipy'], stdout: () => {}, stderr: (line) => console.debug(line),
  });
  const ours = await (await fetched(`${HERE}ours.zip`)).arrayBuffer();
  python.unpackArchive(ours, 'zip', { extractDir: '/ours' });
  python.runPython("import sys; sys.path.append('/ours')");
  return python.pyimport('try_work');
}

let started;

self.onmessage = async ({ data }) => {
  try {
    if (started === undefined) tell('step', 'Starting Python: 38 MB, once');
    started ??= start();
    const work = await started;
    work.run(data.effect, data.seed, tell);
    tell('done', '');
  } catch (error) {
    // Of a traceback the last line says what is wrong.
    tell('failed', String(error.message ?? error).trim().split('\n').pop());
  }
};
