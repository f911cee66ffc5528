// Names that avatars give to their shapes. The table is shared/face/shape_names.txt, and
// shared/face/shape_names.py explains it.

using System;
using System.Collections.Generic;
using System.Linq;
using System.Text.RegularExpressions;

public static class KouxingShapeNames
{
    const string Table = @"
arkit *jawOpen=mouthOpen jawForward jawLeft jawRight mouthClose mouthLeft mouthRight tongueOut
 *mouthPucker=Mouth_Pucker_Up_L+Mouth_Pucker_Up_R+Mouth_Pucker_Down_L+Mouth_Pucker_Down_R
 mouthFunnel=Mouth_Funnel_Up_L+Mouth_Funnel_Up_R+Mouth_Funnel_Down_L+Mouth_Funnel_Down_R
 mouthRollLower=Mouth_Roll_In_Lower_L+Mouth_Roll_In_Lower_R mouthShrugLower mouthShrugUpper
 mouthRollUpper=Mouth_Roll_In_Upper_L+Mouth_Roll_In_Upper_R mouthPressLeft mouthPressRight
 mouthLowerDownLeft=Mouth_Down_Lower_L mouthLowerDownRight=Mouth_Down_Lower_R
 mouthUpperUpLeft=Mouth_Up_Upper_L mouthUpperUpRight=Mouth_Up_Upper_R
 mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft
 mouthDimpleRight mouthStretchLeft mouthStretchRight noseSneerLeft noseSneerRight
 browInnerUp=Brow_Raise_Inner_L+Brow_Raise_Inner_R cheekPuff=Cheek_Puff_L+Cheek_Puff_R
 browOuterUpLeft=Brow_Raise_Outer_L browOuterUpRight=Brow_Raise_Outer_R
 browDownLeft=Brow_Drop_L browDownRight=Brow_Drop_R
 cheekSquintLeft=Cheek_Raise_L cheekSquintRight=Cheek_Raise_R
 eyeBlinkLeft=Eyes_Closed_L eyeBlinkRight=Eyes_Closed_R
 eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight
 eyeLookUpLeft=Eye_L_Look_Up eyeLookUpRight=Eye_R_Look_Up
 eyeLookDownLeft=Eye_L_Look_Down eyeLookDownRight=Eye_R_Look_Down
 eyeLookInLeft=Eye_L_Look_R eyeLookInRight=Eye_R_Look_L
 eyeLookOutLeft=Eye_L_Look_L eyeLookOutRight=Eye_R_Look_R
oculus *aa=V_Open=vAA *PP=V_Explosive=vM FF=V_Dental_Lip=vF TH=vTH DD=V_Tongue_Up=vT kk=vK
 CH=V_Affricate=vSH SS=vS nn=vL RR=vER sil E=viseme_E=v_E=vEH
 *ih=viseme_I=V_Wide=vIH *oh=viseme_O=V_Tight_O=vOW *ou=viseme_U=V_Tight=vUW
vrm *aa=A=MTH_A=Mouth_A=Vowel_A=Lip_A=Ah=あ=ア=ｱ *ih=I=MTH_I=Mouth_I=Vowel_I=Lip_I=い=イ=ｲ
 *ou=U=MTH_U=Mouth_U=Vowel_U=Lip_U=Oo=う=ウ=ｳ *ee=E=MTH_E=Mouth_E=Vowel_E=Lip_E=Eh=え=エ=ｴ
 *oh=O=MTH_O=Mouth_O=Vowel_O=Lip_O=お=オ=ｵ blink=EYE_Close=EYE_DEF_C=Eyes_Closed=まばたき=瞬き
 blinkLeft=EYE_Close_L=Wink_L=ウィンク２=ウィンク2=ｳｨﾝｸ２=ｳｨﾝｸ2=ウィンク=ウインク=ｳｨﾝｸ
 blinkRight=EYE_Close_R=Wink_R=ウィンク２右=ウィンク2右=ｳｨﾝｸ２右=ｳｨﾝｸ2右=ウィンク右=ウインク右=ｳｨﾝｸ右
 lookUp lookDown lookLeft lookRight
";

    sealed class Entry
    {
        public string Shape;
        public string[][] Choices; // each is a sum of parts
        public bool IsNeeded;
    }

    static readonly Dictionary<string, string> Titles = new Dictionary<string, string>
        { ["arkit"] = "ARKit", ["oculus"] = "Oculus", ["vrm"] = "VRM" };
    static readonly Regex Separator = new Regex(@"[._:|/\- ]|eCTRL|(?<=[a-z])(?=[A-Z])");
    static readonly Dictionary<string, List<Entry>> Sets = ReadTable();

    /// Return the shape of each recognized name of a mesh, by name.
    public static Dictionary<string, string> FindShapes(string set, IEnumerable<string> names)
    {
        var known = new HashSet<string>(Sets[set].SelectMany(entry => entry.Choices.SelectMany(parts => parts)));
        var byKey = new Dictionary<string, string>();
        foreach (string name in names)
        {
            string key = Candidates(name).FirstOrDefault(known.Contains);
            if (key != null && !byKey.ContainsKey(key)) byKey[key] = name;
        }
        var shapes = new Dictionary<string, string>();
        foreach (Entry entry in Sets[set])
            foreach (string key in entry.Choices.FirstOrDefault(parts => parts.Any(byKey.ContainsKey)) ?? new string[0])
                if (byKey.TryGetValue(key, out string name)) shapes[name] = entry.Shape;
        return shapes;
    }

    /// Return the set that moves an avatar with these names: the first that is complete, or the
    /// nearest to that. Throw an exception if the avatar cannot speak.
    public static string ChooseSet(IReadOnlyCollection<string> names)
    {
        var options = Sets.Keys.Select(set =>
        {
            var found = new HashSet<string>(FindShapes(set, names).Values);
            var needed = Sets[set].Where(entry => entry.IsNeeded).Select(entry => entry.Shape).ToList();
            var missing = needed.Where(shape => !found.Contains(shape)).ToList();
            double share = (double)missing.Count / needed.Count - found.Count / 1000.0; // between equals, known shapes decide
            return new { set, missing, speaks = found.Contains(needed[0]), share };
        }).ToList();
        var speaking = options.Where(option => option.speaks).ToList();
        var complete = speaking.FirstOrDefault(option => option.missing.Count == 0);
        if (complete != null) return complete.set;
        if (speaking.Count > 0) return Enumerable.Reverse(speaking).OrderBy(option => option.share).First().set;
        var nearest = options.OrderBy(option => option.share).First();
        throw new InvalidOperationException(
            $"the avatar cannot speak: it has no shape {string.Join(", ", nearest.missing)} of {Titles[nearest.set]}; "
            + "use an avatar with the shapes of ARKit, Oculus or VRM");
    }

    /// Remove a number at the end of a name, and write the side before it as a word.
    static string Sided(string name)
    {
        name = Regex.Replace(name, @"[._ ](div)?\d+$", ""); // Blender appends .001, Daz _div2
        name = Regex.Replace(name, @"([._\- ][Ll]|(?<=[a-z])L)$", "Left");
        return Regex.Replace(name, @"([._\- ][Rr]|(?<=[a-z])R)$", "Right");
    }

    static string ToKey(string name) => Separator.Replace(name, "").ToLowerInvariant();

    /// Return the keys of a name without none, one, two, ... words at its beginning.
    static IEnumerable<string> Candidates(string name)
    {
        name = Sided(name);
        yield return ToKey(name);
        foreach (Match separator in Separator.Matches(name))
        {
            string key = ToKey(name.Substring(separator.Index + separator.Length));
            int least = separator.Length == 0 ? 7 : ".:|/".Contains(separator.Value) ? 0 : 2;
            if (key.Length >= least) yield return key;
        }
    }

    static Dictionary<string, List<Entry>> ReadTable()
    {
        var sets = new Dictionary<string, List<Entry>>();
        string set = "";
        foreach (string line in Table.Trim().Split('\n'))
        {
            var words = line.Split(new[] { ' ', '\r' }, StringSplitOptions.RemoveEmptyEntries).ToList();
            if (line[0] != ' ')
            {
                set = words[0];
                sets[set] = new List<Entry>();
                words.RemoveAt(0);
            }
            foreach (string word in words)
            {
                string[] choices = word.TrimStart('*').Split('=');
                sets[set].Add(new Entry
                {
                    Shape = choices[0],
                    Choices = choices.Select(c => c.Split('+').Select(p => ToKey(Sided(p))).ToArray()).ToArray(),
                    IsNeeded = word[0] == '*',
                });
            }
        }
        return sets;
    }
}
