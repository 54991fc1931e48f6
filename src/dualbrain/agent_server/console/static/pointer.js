// The place in a JSON text that a JSON pointer (RFC 6901) names, as [start, end]; null if the text has no such place.
export function findPlace(text, pointer) {
  const path = pointer.split("/").slice(1).map((part) => part.replaceAll("~1", "/").replaceAll("~0", "~"));
  const token = /\s*("(?:[^"\\]|\\.)*"|[{}[\],:]|[^\s{}[\],:"]+)/y;
  const next = () => { const found = token.exec(text); return found ? { word: found[1], start: token.lastIndex - found[1].length, end: token.lastIndex } : null; };

  // Reads one value; returns the place of the value at `rest` in it, or null.
  function value(rest) {
    const first = next();
    if (!first) return null;
    let found = null;
    if (first.word === "{" || first.word === "[") {
      const closing = first.word === "{" ? "}" : "]";
      for (let k = 0; ; k += 1) {
        const before = token.lastIndex, here = next();
        if (!here) return found;
        if (here.word === closing) break;
        if (here.word === ",") { k -= 1; continue; }
        let name = String(k);
        if (closing === "}") { try { name = JSON.parse(here.word); } catch { return found; } next(); } else token.lastIndex = before;
        const inner = value(name === rest?.[0] ? rest.slice(1) : null);
        found = found || inner;
      }
    }
    return rest && rest.length === 0 ? [first.start, token.lastIndex] : found;
  }
  return value(path);
}
