import { defineConfig } from "vite";

export default defineConfig({
  base: "./",
  server: { fs: { allow: ["../.."] } }, // out/npm and assets/head.glb
  build: { chunkSizeWarningLimit: 1000 }, // kB; three.js alone needs 700
});
