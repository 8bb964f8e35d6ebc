import { defineConfig } from "vite";

const NO_ANIMATION = new URL("src/map/no_animation.ts", import.meta.url).pathname;

// One script and one style sheet under fixed names, nothing inlined: the server sends a strict
// Content-Security-Policy, and continuous integration compares the bytes of a new build.
export default defineConfig({
  base: "./",
  resolve: { alias: { "d3-transition": NO_ANIMATION, "d3-interpolate": NO_ANIMATION } },
  build: {
    outDir: "../static",
    emptyOutDir: true,
    license: { fileName: "licences.md" }, // of what the script holds: they ask for it
    target: "es2022",
    assetsInlineLimit: 0,
    modulePreload: false,
    cssCodeSplit: false,
    rollupOptions: {
      output: {
        entryFileNames: "mapfold.js",
        chunkFileNames: "mapfold-[name].js",
        assetFileNames: "mapfold[extname]",
      },
    },
  },
  server: { proxy: { "/api": "http://127.0.0.1:8797" } },
});
