// Fills the list of versions in the sidebar, which a site that was built by itself does not have. Where there is no
// versions.json above this version's folder, or pages are read from files, the list stays hidden.
"use strict";

addEventListener("DOMContentLoaded", async () => {
  const box = document.querySelector(".versions");
  if (!box || !location.protocol.startsWith("http")) return; // pages in files may not read one another
  const site = new URL("./" + box.dataset.root.replace(/[^/]*$/, ""), location.href); // the folder of this version
  try {
    const answer = await fetch(new URL("../versions.json", site));
    if (!answer.ok) return;
    const versions = await answer.json(); // [{"name": "0.2.0", "folder": "0.2.0"}, ...], the newest first
    const list = box.querySelector("select");
    const here = decodeURIComponent(site.pathname.split("/").at(-2));
    for (const { name, folder } of versions) {
      list.add(new Option(name, folder, folder === here, folder === here));
    }
    const page = location.href.slice(site.href.length);
    list.addEventListener("change", async () => {
      const other = new URL(`../${encodeURIComponent(list.value)}/`, site);
      const same = new URL(page, other); // the same page where the other version has it, its first page otherwise
      const there = await fetch(same, { method: "HEAD" });
      location.href = there.ok ? same : other;
    });
    box.hidden = versions.length < 2;
  } catch {
    // No list of versions: nothing to choose from.
  }
});
