//! The HTML of an exported page.

use super::page::Page;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use cc4dgs_format::{Error, Result};
use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::{Map, Value, json};
use std::io::Write;

const TEMPLATE: &str = include_str!("page.html");
/// Modules inside one file have no addresses; they import each other by names with this prefix, which an import map resolves.
const PREFIX: &str = "cc4dgs/";
/// Starts the player of a single file from the contents of its other elements. What fails before there is a player is said on the page.
const START: &str = r#"const element = document.getElementById("player");
const bytes = id => {
    const text = atob(document.getElementById(id).textContent), out = new Uint8Array(text.length);
    for (let i = 0; i < out.length; i++) out[i] = text.charCodeAt(i);
    return out;
};
const unpacked = packed => new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
try {
    const { createPlayer } = await import("cc4dgs/player.js");
    const { name, autoplay } = JSON.parse(document.getElementById("settings").textContent);
    const wasm = await unpacked(bytes("renderer")), src = bytes("model");
    window.cc4dgs = await createPlayer(element, { src, name, wasm, autoplay });
} catch (e) {
    element.textContent = `The player could not be started (${e.message}). Download or copy this file again; where that does not help, export it again.`;
    throw e;
}"#;

/// Longest text that a browser (V8) holds, in characters.
const MOST_TEXT: usize = (1 << 29) - 24;

/// Says what would leave the page blank: browsers without import maps or `DecompressionStream`, and files that end before the end of the script that starts the
/// player.
const BLANK: &str = r#"<script>
if (!window.DecompressionStream || !HTMLScriptElement.supports || !HTMLScriptElement.supports("importmap")) document.getElementById("player").textContent =
    "This page needs a newer browser: Chrome or Edge 96, Firefox 113, Safari 16.4, or later.";
else document.addEventListener("DOMContentLoaded", () => {
    if (!document.getElementById("end")) document.getElementById("player").textContent =
        "This file is not complete: its end is missing. Download or copy it again; where that does not help, export it again.";
});
</script>
"#;

/// What a complete file has behind the script that starts the player: a script without its end is not run.
const END: &str = "<i id=\"end\" hidden></i>\n";

/// `text` with the special characters of HTML escaped.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// JSON inside a script element: no text in it can end the element.
fn script_json(value: &Value) -> String {
    value.to_string().replace('<', "\\u003c")
}

fn document(title: &str, head: &str, body: &str) -> String {
    // Parts of the template are replaced in one pass, because the inserted text may contain their names.
    let mut out = String::with_capacity(TEMPLATE.len() + title.len() + head.len() + body.len());
    let mut rest = TEMPLATE;
    for (key, value) in [("{title}", escaped(title)), ("{head}", head.to_string()), ("{body}", body.to_string())] {
        let (before, after) = rest.split_once(key).unwrap_or((rest, ""));
        out.push_str(before);
        out.push_str(&value);
        rest = after;
    }
    out.push_str(rest);
    out
}

/// The page of a folder: it loads `model` under the name `title`, or what its address asks for (`?src=`); `?autoplay` plays it even where `autoplay` is off.
pub(super) fn of_folder(title: &str, model: &str, autoplay: bool) -> String {
    let options = script_json(&json!({ "autoplay": autoplay, "name": title, "src": model }));
    let body = format!(
        r#"<script>
if (location.protocol === "file:") document.getElementById("player").textContent =
    "This folder needs a web server: python3 -m http.server. Export with a name that ends in .html for a page that opens from disk.";
</script>
<script type="module">
const element = document.getElementById("player");
const {{ createPlayer }} = await import("./player.js").catch(e => {{
    if (location.protocol !== "file:") element.textContent =
        `The player could not be loaded (${{e.message}}). Files of this page are missing or damaged: put player.js, cc4dgs_player.js and all others of its folder beside the page, and reload it.`;
    throw e;
}});
const options = {options};
const query = new URLSearchParams(location.search), asked = query.get("src");
// Another model has the name of its file.
if (asked !== null && asked !== options.src) Object.assign(options, {{ src: asked, name: undefined }});
options.autoplay ||= query.has("autoplay");
window.cc4dgs = await createPlayer(element, options);
</script>"#
    );
    document(title, r#"<link rel="stylesheet" href="player.css">"#, &body)
}

/// Refuses an archive of so many `bytes` that browsers cannot read it out of an HTML file.
fn check_size(bytes: usize) -> Result<()> {
    let most = MOST_TEXT / 4 * 3;
    if bytes > most {
        let remedy = "Give a name that does not end in .html: a folder holds the archive as a file of its own";
        return Err(Error::limit("archive in one HTML file, in bytes", bytes as u64, most as u64, remedy));
    }
    Ok(())
}

/// Everything in one file: styles, modules, the renderer (gzip) and `archive`, which is compressed already.
pub(super) fn single(page: &Page, title: &str, archive: &[u8], autoplay: bool) -> Result<String> {
    check_size(archive.len())?;
    let damaged = |name: &str, problem: &str| Error::data(format!("{}: {name}", page.origin), problem, "Build the page again with apps/player/build-web");
    let text = |name: &str| std::str::from_utf8(page.file(name)).map_err(|_| damaged(name, "it is not UTF-8"));
    let style = text("player.css")?;
    if style.contains("</") {
        return Err(damaged("player.css", "it contains '</', which would end the style element"));
    }
    let modules: Vec<&str> = page.files.iter().map(|(name, _)| *name).filter(|name| name.ends_with(".js")).collect();
    let mut imports = Map::new();
    for name in &modules {
        let mut source = text(name)?.to_string();
        for other in &modules {
            for quote in ['"', '\''] {
                source = source.replace(&format!("from {quote}./{other}{quote}"), &format!("from {quote}{PREFIX}{other}{quote}"));
            }
        }
        if source.contains("from \"./") || source.contains("from './") {
            return Err(damaged(name, "it imports a module that is not part of the page"));
        }
        imports.insert(format!("{PREFIX}{name}"), format!("data:text/javascript;base64,{}", STANDARD.encode(source)).into());
    }
    let mut packer = GzEncoder::new(Vec::new(), Compression::best());
    let packed = packer.write_all(page.file("cc4dgs_player_bg.wasm")).and_then(|()| packer.finish());
    let packed = packed.map_err(|e| Error::backend("gzip", e.to_string(), "Report this"))?;
    let data = |id: &str, kind: &str, content: &str| format!("<script type=\"{kind}\" id=\"{id}\">{content}</script>\n");
    let head = format!("<style>\n{style}</style>\n<script type=\"importmap\">{}</script>", script_json(&json!({ "imports": imports })));
    let body = [
        BLANK.to_string(),
        data("settings", "application/json", &script_json(&json!({ "autoplay": autoplay, "name": title }))),
        data("renderer", "text/plain", &STANDARD.encode(packed)),
        data("model", "text/plain", &STANDARD.encode(archive)),
        data("start", "module", &format!("\n{START}\n")),
        END.to_string(),
    ];
    Ok(document(title, &head, &body.concat()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::web::page::PAGE_FILES;

    fn page() -> Page {
        let content = |name: &str| if name == "player.js" { "import { a } from \"./controls.js\"; // {body}".to_string() } else { format!("/* {name} */") };
        Page { files: PAGE_FILES.into_iter().map(|name| (name, content(name).into_bytes())).collect(), origin: "test".into() }
    }

    #[test]
    fn modules_find_each_other_without_addresses() {
        let html = single(&page(), "a <b> & {head}", b"archive", false).unwrap();
        assert!(html.contains("<title>a &lt;b&gt; &amp; {head}</title>") && html.contains(r#"{"autoplay":false,"name":"a \u003cb> & {head}"}"#), "{html}");
        assert!(html.contains(&STANDARD.encode("archive")) && html.contains("/* player.css */"));
        let source = html.split("cc4dgs/player.js\":\"data:text/javascript;base64,").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!(STANDARD.decode(source).unwrap(), b"import { a } from \"cc4dgs/controls.js\"; // {body}");
        assert!(!html.contains("src=\"") && !html.contains("href=\"player"), "nothing is fetched");
        let (told, started) = (html.find("newer browser").unwrap(), html.find("createPlayer").unwrap());
        assert!(told < started, "old browsers are told before anything fails");
    }

    #[test]
    fn a_file_that_is_cut_off_or_damaged_says_so() {
        let html = single(&page(), "t", b"archive", true).unwrap();
        let (said, model) = (html.find("its end is missing").unwrap(), html.find(r#"id="model""#).unwrap());
        assert!(said < model, "the script that says so is cut off, too");
        // It looks for what is behind the script that starts the player, which is the last.
        let start = html.find(r#"<script type="module" id="start">"#).unwrap();
        assert!(start > model && html[start..].matches("<script").count() == 1, "{html}");
        let end = html.rfind("</script>").unwrap();
        assert!(html[..said].contains(r#"getElementById("end")"#) && html[end..].contains(r#"id="end""#) && !html[..end].contains(r#"id="end""#), "{html}");
        let (tries, says) = (html[start..].find("try {").unwrap(), html[start..].find("could not be started (${e.message})").unwrap());
        assert!(["import(\"cc4dgs/player.js\")", "bytes(\"renderer\")", "bytes(\"model\")"].iter().all(|work| {
            let at = html[start..].find(work).unwrap();
            tries < at && at < says
        }));
    }

    #[test]
    fn a_page_that_would_not_load_is_refused() {
        let mut other = page();
        other.files[0].1 = b"import { a } from \"./unknown.js\";".to_vec();
        assert!(single(&other, "t", b"", true).unwrap_err().to_string().contains("player.js"));
        let mut other = page();
        other.files.iter_mut().find(|(name, _)| *name == "player.css").unwrap().1 = b"a { } </style><script>".to_vec();
        assert!(single(&other, "t", b"", true).unwrap_err().to_string().contains("player.css"));
    }

    #[test]
    fn archives_that_no_browser_reads_from_html_are_refused() {
        check_size(400_000_000).unwrap();
        assert!(check_size(403_000_000).unwrap_err().to_string().contains(".html"));
    }

    #[test]
    fn a_folder_without_its_player_says_so() {
        let html = of_folder("t", "model.cc4d", true);
        let (loads, says) = (html.find("import(\"./player.js\").catch").unwrap(), html.find("could not be loaded (${e.message})").unwrap());
        assert!(loads < says && html.contains("cc4dgs_player.js and all others of its folder"), "{html}");
        // The page that build-web copies says the same.
        assert!(include_str!("../../../apps/player/web/index.html").contains(html[says..].lines().next().unwrap()));
    }

    #[test]
    fn both_pages_name_the_model_and_say_what_they_need_without_scripts() {
        for html in [of_folder("mutant", "model.cc4d", true), single(&page(), "mutant", b"archive", true).unwrap()] {
            assert!(html.contains("<title>mutant</title>") && html.contains(r#""name":"mutant""#), "{html}");
            assert!(html.contains("<noscript>This page needs JavaScript."), "{html}");
        }
        let folder = of_folder("mutant", "model.cc4d", true);
        assert!(folder.contains("Object.assign(options, { src: asked, name: undefined })") && folder.contains(r#"query.has("autoplay")"#), "{folder}");
    }

    #[test]
    fn names_cannot_leave_their_script() {
        let html = of_folder("</script><script>alert(1)</script>", "</script>x", true);
        assert_eq!(html.matches("</script>").count(), 2, "{html}");
    }
}
