// Unity 2021 or newer: add this to an avatar. Every SkinnedMeshRenderer below it that has blend
// shapes with ARKit's names follows the session.

using System.Collections.Generic;
using UnityEngine;

public sealed class KouxingFace : MonoBehaviour
{
    [SerializeField] string gateway = "ws://127.0.0.1:8080";
    [SerializeField, Tooltip("The session to follow; empty: the newest")] string session = "";
    [SerializeField, Tooltip("Unity's blend shapes go from 0 to 100")] float fullWeight = 100f;

    readonly List<(SkinnedMeshRenderer mesh, int shape, string name)> _shapes =
        new List<(SkinnedMeshRenderer, int, string)>();
    KouxingStream _stream;

    void OnEnable()
    {
        _shapes.Clear();
        foreach (var mesh in GetComponentsInChildren<SkinnedMeshRenderer>())
            for (int shape = 0; shape < mesh.sharedMesh.blendShapeCount; shape++)
            {
                // "Face.jawOpen" and "blendShape1.jawOpen" are jawOpen, too
                string name = mesh.sharedMesh.GetBlendShapeName(shape);
                _shapes.Add((mesh, shape, name.Substring(name.LastIndexOf('.') + 1)));
            }
        _stream = new KouxingStream(gateway, session);
    }

    void OnDisable() => _stream.Dispose();

    void LateUpdate() // after the Animator
    {
        var (names, weights) = (_stream.Names, _stream.Weights);
        if (weights.Length != names.Count) return;
        var face = new Dictionary<string, float>();
        for (int place = 0; place < weights.Length; place++) face[names[place]] = weights[place];
        foreach (var each in _shapes)
            if (face.TryGetValue(each.name, out float weight))
                each.mesh.SetBlendShapeWeight(each.shape, fullWeight * weight);
    }
}
