// Before anything is unpacked: can this browser show the page at all? Then unpack the page's script and run
// it.

import * as assets from './assets.js';
import { sorry } from './sorry.js';

function missing() {
  const canvas = document.createElement('canvas');
  if (!canvas.getContext('webgl2'))
    return [
      'This page draws in 3D and your browser offers no WebGL 2.',
      'Turn on hardware acceleration, or open the page in a current Firefox, Chrome, Edge or Safari.',
    ];
  if (typeof WebAssembly !== 'object')
    return [
      'The behavior model runs in WebAssembly, which is switched off here.',
      'Open the page in another browser, or leave lockdown mode for it.',
    ];
  if (typeof DecompressionStream !== 'function')
    return ['Your browser is too old to unpack this page.', 'A browser of 2023 or later will do.'];
  return null;
}

async function start() {
  const script = document.createElement('script');
  script.src = URL.createObjectURL(new Blob([await assets.bytes('page')], { type: 'text/javascript' }));
  document.head.append(script);
}

const lack = missing();
if (lack) sorry(...lack);
else
  start().catch((error) =>
    sorry(
      `This page cannot be unpacked: ${error.message}`,
      'Copy it again as a whole; a folder needs its `assets` beside `index.html`.',
    ),
  );
