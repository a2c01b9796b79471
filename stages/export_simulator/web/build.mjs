// Bundle the page's script and the sampler's worker, and compress them with the WebAssembly runtime, into
// dist/ (or the folder named on the command line).
import { build } from 'esbuild';
import { createHash } from 'node:crypto';
import { copyFileSync, mkdirSync, readFileSync, readdirSync, writeFileSync } from 'node:fs';
import { gzipSync } from 'node:zlib';

const shared = {
  bundle: true,
  minify: true,
  format: 'iife',
  target: 'es2022',
  legalComments: 'none',
  write: false,
  charset: 'utf8',
};
const store = (name, bytes) => writeFileSync(`${folder}/${name}.gz`, gzipSync(bytes, { level: 9 }));

const folder = process.argv[2] ?? 'dist';
mkdirSync(folder, { recursive: true });
const bundle = async (entry) =>
  (await build({ ...shared, entryPoints: [entry], define: { 'import.meta.url': '"blob:null/"' } }))
    .outputFiles[0].text;
// The libraries start WebAssembly as they load: the first script makes sure that there is any, and unpacks
// the rest.
writeFileSync(`${folder}/boot.js`, await bundle('src/boot.js'));
store('page.js', await bundle('src/main.js'));
store('worker.js', await bundle('src/worker.js'));
store('ort.wasm', readFileSync('node_modules/onnxruntime-web/dist/ort-wasm-simd-threaded.wasm'));
// The notices that the bundled libraries ask to be kept; the page carries them as a comment.
const library = (name) => readFileSync(`node_modules/${name}/LICENSE`, 'utf8').trim();
const notices = [
  ['three.js', library('three')],
  ['Spark', library('@sparkjsdev/spark')],
  ['fflate', library('fflate')],
  [
    'ONNX Runtime Web',
    `${library('three').split('\n')[0]}\n\nCopyright © Microsoft Corporation\n\nTerms as above.`,
  ],
];
writeFileSync(
  `${folder}/NOTICES.txt`,
  notices.map(([name, text]) => `${name}\n\n${text.replaceAll('--', '- -')}\n`).join('\n'),
);

copyFileSync('src/page.html', `${folder}/page.html`);
copyFileSync('src/style.css', `${folder}/style.css`);
// What the bundle was made of, so that a bundle older than its sources is noticed where there is no node.
const sources = ['build.mjs', 'package-lock.json', ...readdirSync('src').map((name) => `src/${name}`)].sort();
const digest = (name) => createHash('sha256').update(readFileSync(name)).digest('hex');
writeFileSync(
  `${folder}/sources.json`,
  `${JSON.stringify(Object.fromEntries(sources.map((name) => [name, digest(name)])), null, 1)}\n`,
);
