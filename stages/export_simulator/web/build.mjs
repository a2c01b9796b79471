// Bundle the page's script and the sampler's worker, and compress them with the WebAssembly runtime, into dist/.
import { build } from 'esbuild';
import { copyFileSync, mkdirSync, readFileSync, writeFileSync } from 'node:fs';
import { gzipSync } from 'node:zlib';

const shared = { bundle: true, minify: true, format: 'iife', target: 'es2022', legalComments: 'none', write: false, charset: 'utf8' };
const store = (name, bytes) => writeFileSync(`dist/${name}.gz`, gzipSync(bytes, { level: 9 }));

mkdirSync('dist', { recursive: true });
for (const [name, entry] of [['page.js', 'src/main.js'], ['worker.js', 'src/worker.js']]) {
  const result = await build({ ...shared, entryPoints: [entry], define: { 'import.meta.url': '"blob:null/"' } });
  store(name, result.outputFiles[0].contents);
}
store('ort.wasm', readFileSync('node_modules/onnxruntime-web/dist/ort-wasm-simd-threaded.wasm'));
// The notices that the bundled libraries ask to be kept; the page carries them as a comment.
const library = (name) => readFileSync(`node_modules/${name}/LICENSE`, 'utf8').trim();
const notices = [
  ['three.js', library('three')],
  ['Spark', library('@sparkjsdev/spark')],
  ['fflate', library('fflate')],
  ['ONNX Runtime Web', `${library('three').split('\n')[0]}\n\nCopyright © Microsoft Corporation\n\nTerms as above.`],
];
writeFileSync('dist/NOTICES.txt', notices.map(([name, text]) => `${name}\n\n${text.replaceAll('--', '- -')}\n`).join('\n'));

copyFileSync('src/page.html', 'dist/page.html');
copyFileSync('src/style.css', 'dist/style.css');
