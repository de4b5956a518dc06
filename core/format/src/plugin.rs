//! Facts about plug-ins, and the collection of the linked plug-ins of a kind by name.

use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;

/// Facts of one registry entry.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Plugin {
    /// The name used in configurations, in lower-case kebab case.
    pub name: &'static str,
    /// Version of the plug-in's stored form.
    pub version: &'static str,
    /// A summary of one line.
    pub summary: &'static str,
    /// The paper or work that the method comes from.
    pub paper: &'static str,
    /// Settings with defaults, as TOML text with comments.
    pub schema: &'static str,
    /// Capabilities, such as `differentiable`, `static-only`, `profiles=…`, or `bits=3..16`: the range of the bits in the setting
    /// `array_bits` of a weight codec, a list with a number for each array.
    pub capabilities: &'static [&'static str],
}

/// A kind of plug-in: what `inventory::submit!` takes.
pub trait PluginEntry: Sized + Sync + 'static {
    /// The kind's name: its section in configurations, its method of the registry, its folder.
    const KIND: &'static str;
    /// Facts of this entry.
    fn info(&self) -> &Plugin;
    /// All entries that are linked into this program, in no particular order.
    fn linked() -> Vec<&'static Self>;
}

/// Implements [`PluginEntry`] for a plug-in struct with a field `info`, and registers the type with inventory.
#[macro_export]
macro_rules! plugin_kind {
    ($plugin:ty, $kind:literal) => {
        $crate::inventory::collect!($plugin);
        impl $crate::PluginEntry for $plugin {
            const KIND: &'static str = $kind;
            fn info(&self) -> &$crate::Plugin {
                &self.info
            }
            fn linked() -> Vec<&'static Self> {
                $crate::inventory::iter::<$plugin>.into_iter().collect()
            }
        }
    };
}

/// The linked plug-ins of one kind by name.
pub struct Entries<P: 'static>(BTreeMap<&'static str, &'static P>);

impl<P: PluginEntry> Entries<P> {
    /// Collects all linked plug-ins of this kind.
    ///
    /// # Errors
    /// [`Error::Parameter`] if two plug-ins have the same name, and for a name with other characters than lower-case letters, digits and '-': some have a
    /// meaning where names are written (`codec:profile`, `family+method`).
    pub fn collect() -> Result<Self> {
        let mut map = BTreeMap::new();
        for plugin in P::linked() {
            let name = plugin.info().name;
            if name.is_empty() || !name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-') {
                let problem = "the name of a plug-in has lower-case letters, digits and '-', and nothing else";
                return Err(Error::parameter(format!("{} '{name}'", P::KIND), problem, "Rename it where it is registered"));
            }
            if map.insert(name, plugin).is_some() {
                return Err(Error::parameter(format!("{} {name}", P::KIND), "two plug-ins registered this name", "Rename one of them or link only one"));
            }
        }
        Ok(Self(map))
    }
    /// The entry called `name`.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a name that no linked plug-in has; it lists similar names.
    pub fn get(&self, name: &str) -> Result<&'static P> {
        self.0.get(name).copied().ok_or_else(|| self.not_linked(name))
    }
    fn not_linked(&self, name: &str) -> Error {
        let remedy = match self.0.is_empty() {
            true => "Nor is any other of this kind: name the crate of the plug-in in the program or test, as in `use my_plugins as _;`".to_string(),
            false => similar_names(name, self.0.keys().copied()),
        };
        Error::parameter(format!("{} '{name}'", P::KIND), "no plug-in of this name is linked into this program", remedy)
    }
    /// All entries, sorted by name.
    pub fn iter(&self) -> impl Iterator<Item = &'static P> + '_ {
        self.0.values().copied()
    }
    /// (kind, facts) of all entries, sorted by name.
    pub fn facts(&self) -> impl Iterator<Item = (&'static str, &'static Plugin)> + '_ {
        self.iter().map(|p| (P::KIND, p.info()))
    }
}

/// The `known` names without repetitions, those that are most like `name` first.
pub fn by_likeness<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let likeness = |other: &str| strsim::jaro_winkler(other, name).max(strsim::normalized_damerau_levenshtein(other, name));
    let mut known: Vec<&str> = known.collect();
    known.sort_by(|a, b| likeness(b).total_cmp(&likeness(a)).then(a.cmp(b)));
    known.dedup();
    known
}

/// An error for the unknown `name` of a `kind`; it lists all `known` names and the most similar ones.
pub fn unknown_name<'a>(kind: &str, name: &str, known: impl Iterator<Item = &'a str>) -> Error {
    Error::parameter(format!("{kind} '{name}'"), "unknown name", similar_names(name, known))
}

/// All `known` names, those that are most like `name` first, in words.
fn similar_names<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> String {
    let known = by_likeness(name, known);
    if known.is_empty() {
        return "There are none; leave it out".into();
    }
    // Jaro-Winkler misses swapped letters in short names; edit distance misses long names that share only a prefix.
    let few_edits = |k: &str| strsim::damerau_levenshtein(k, name) <= (name.chars().count() / 3).min(2);
    let near: Vec<&str> = known.iter().copied().filter(|k| strsim::jaro_winkler(k, name) > 0.75 || few_edits(k)).take(3).collect();
    if near.is_empty() { format!("Known: {}", known.join(", ")) } else { format!("Did you mean {}? Known: {}", near.join(" or "), known.join(", ")) }
}

/// Refuses the plug-in `name` of a `kind`, which the file `object` needs, if it is not among the `linked` ones, or reads another version than the `stored` one.
///
/// # Errors
/// [`Error::Unsupported`] that says which program to use.
pub fn check_linked<'a>(object: &str, kind: &str, name: &str, stored: Option<&str>, linked: impl Iterator<Item = &'a Plugin>) -> Result<()> {
    let linked: Vec<&Plugin> = linked.collect();
    let Some(plugin) = linked.iter().find(|p| p.name == name) else {
        let names: Vec<&str> = linked.iter().map(|p| p.name).collect();
        let remedy = format!("Use a program that links the crate of this {kind}; this one links {}", names.join(", "));
        let version = stored.map_or_else(String::new, |version| format!(" (version {version})"));
        return Err(Error::unsupported(object, format!("it needs the {kind} '{name}'{version}, which is not linked into this program"), remedy));
    };
    let Some(stored) = stored.filter(|stored| *stored != plugin.version) else { return Ok(()) };
    let remedy = format!("This program reads version {}", plugin.version);
    Err(Error::unsupported(format!("{object}: {kind} {name}"), format!("version {stored} of its stored form"), remedy))
}

/// Splits a plug-in section into its `kind` and the other settings. `object` is the section's name in errors.
///
/// # Errors
/// [`Error::Parameter`] if `kind` is missing or not a string.
pub fn split_kind(object: &str, section: &toml::Table) -> Result<(String, toml::Table)> {
    let mut settings = section.clone();
    match settings.remove("kind") {
        Some(toml::Value::String(kind)) => Ok((kind, settings)),
        Some(other) => Err(Error::parameter(format!("{object}.kind"), format!("{other} is not a string"), "Write the plug-in's name in quotes")),
        None => Err(Error::parameter(format!("{object}.kind"), "missing", "Name a plug-in; `cc4dgs plugins` lists them")),
    }
}

#[cfg(test)]
mod tests {
    use super::{Entries, Plugin, PluginEntry, check_linked, unknown_name};

    /// Names of the plug-ins of four programs.
    const LINKED: [&[&str]; 4] = [&[], &["one", "two-2"], &["one", "one"], &["one", "Two:high"]];

    /// A kind of plug-in in the program of this index.
    struct Thing<const PROGRAM: usize>(Plugin);

    impl<const PROGRAM: usize> PluginEntry for Thing<PROGRAM> {
        const KIND: &'static str = "thing";
        fn info(&self) -> &Plugin {
            &self.0
        }
        fn linked() -> Vec<&'static Self> {
            let plugin = |name: &'static str| Box::leak(Box::new(Self(Plugin { name, version: "1", summary: "", paper: "", schema: "", capabilities: &[] })));
            LINKED[PROGRAM].iter().map(|&name| &*plugin(name)).collect()
        }
    }

    #[test]
    fn names_are_unique_and_can_be_written() {
        let twice = Entries::<Thing<2>>::collect().err().unwrap().to_string();
        assert!(twice.starts_with("thing one: two plug-ins registered this name"), "{twice}");
        let odd = Entries::<Thing<3>>::collect().err().unwrap().to_string();
        assert!(odd.starts_with("thing 'Two:high': the name of a plug-in has lower-case letters"), "{odd}");
        assert_eq!(Entries::<Thing<1>>::collect().unwrap().iter().count(), 2);
    }

    #[test]
    fn what_is_not_linked_says_so() {
        let other = Entries::<Thing<1>>::collect().unwrap().get("two").err().unwrap().to_string();
        assert_eq!(other, "thing 'two': no plug-in of this name is linked into this program. Did you mean two-2? Known: two-2, one");
        let none = Entries::<Thing<0>>::collect().unwrap().get("two").err().unwrap().to_string();
        assert!(none.starts_with("thing 'two': no plug-in of this name is linked") && none.contains("use my_plugins as _;"), "{none}");
        assert_eq!(unknown_name("profile", "high", [].into_iter()).to_string(), "profile 'high': unknown name. There are none; leave it out");
    }

    #[test]
    fn plug_ins_that_are_missing_or_of_another_version_are_told_apart() {
        let known = ["cdf", "none"].map(|name| Plugin { name, version: "2", summary: "", paper: "", schema: "", capabilities: &[] });
        let of = |name: &str, stored: Option<&str>| check_linked("a.cc4d", "weight codec", name, stored, known.iter()).map_err(|e| e.to_string());
        assert_eq!([of("cdf", Some("2")), of("none", None)], [Ok(()), Ok(())]);
        let missing = of("cfd", Some("2")).unwrap_err();
        assert!(missing.contains("the weight codec 'cfd' (version 2), which is not linked") && missing.contains("links cdf, none"), "{missing}");
        assert!(of("cfd", None).unwrap_err().contains("the weight codec 'cfd', which is not linked"));
        let other = of("cdf", Some("1")).unwrap_err();
        assert_eq!(other, "a.cc4d: weight codec cdf: version 1 of its stored form. This program reads version 2");
    }

    #[test]
    fn unknown_names_list_near_matches() {
        let message = unknown_name("deformer", "cfd", ["cdf", "none", "swift4d-hash"].into_iter()).to_string();
        assert!(message.contains("Did you mean cdf"), "{message}");
        assert!(message.contains("swift4d-hash"), "{message}");
    }
}
