"""Changes to viser's page: our title, our icon, and two corrections of its JavaScript.

viser has no options for them. If another version of viser has other texts, the page stays as viser made it.
"""

import re
from urllib.parse import quote

TITLE = "completesplat"
ICON = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><g fill-opacity=".8">
<ellipse cx="11" cy="20" rx="9" ry="7" fill="#1971c2"/><ellipse cx="21" cy="20" rx="9" ry="7" fill="#f08c00"/>
<ellipse cx="16" cy="11" rx="8" ry="8" fill="#2f9e44"/></g></svg>"""

# viser's page holds its JavaScript compressed, and inserts it into the document as text. Two parts are replaced in it:
# - The square on which splats are drawn gets corners of three numbers. With two, three.js computes a bounding sphere of
#   radius NaN and reports an error. The square has no place in the scene, and must not be culled by that sphere.
# - The panel of narrow windows starts folded, because it would cover most of the scene.
CORRECTIONS = r"""<script>
document.head.appendChild = function (node) {
  if (node.type === "module")
    node.textContent = node.textContent
      .replace("[-2,-2,2,-2,2,2,-2,2]),2)", "[-2,-2,0,2,-2,0,2,2,0,-2,2,0]),3)")
      .replace(/(`mesh`,\{ref:\w+,geometry:\w+\.geometry,)(material:\w+\.material,renderOrder:)/, "$1frustumCulled:!1,$2")
      .replace(/(\{toggle:\w+\}\]=\w+\()!0(\);return\(0,\w+\.jsx\)\(\w+\.Provider,\{value:\{wrapperRef:)/, "$1!1$2");
  return Node.prototype.appendChild.call(this, node);
};
</script>"""  # noqa: E501


def with_head(page: str) -> str:
    """Return viser's HTML with our title, icon and corrections."""
    icon = f'<link rel="icon" href="data:image/svg+xml,{quote(ICON)}" />'
    page = re.sub(r'<link\s+rel="icon"\s+href="[^"]*"\s*/>', icon, page, count=1)
    page = re.sub(r"<title>[^<]*</title>", f"<title>{TITLE}</title>", page, count=1)
    return page.replace("<head>", f"<head>{CORRECTIONS}", 1)
