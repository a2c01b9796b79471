// Before anything is unpacked: can this browser show the page at all? Sets `window.able`, which the page's script asks.

import { sorry } from './sorry.js';

function missing() {
  const canvas = document.createElement('canvas');
  if (!canvas.getContext('webgl2')) return ['This page draws in 3D and your browser offers no WebGL 2.', 'Turn on hardware acceleration, or open the page in a current Firefox, Chrome, Edge or Safari.'];
  if (typeof WebAssembly !== 'object') return ['The animal thinks in WebAssembly, which is switched off here.', 'Open the page in another browser, or leave lockdown mode for it.'];
  if (typeof DecompressionStream !== 'function') return ['Your browser is too old to unpack this page.', 'A browser of 2023 or later will do.'];
  return null;
}

const lack = missing();
if (lack) sorry(...lack);
window.able = !lack;
