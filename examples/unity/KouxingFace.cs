// Unity 2021 or newer: add this component to an avatar. It moves every SkinnedMeshRenderer below the
// avatar that has blend shapes with ARKit's names.

using System.Collections.Generic;
using UnityEngine;

public sealed class KouxingFace : MonoBehaviour
{
    [SerializeField] string gateway = "ws://127.0.0.1:8080";
    [SerializeField, Tooltip("Session to follow; if empty, the newest")] string session = "";
    [SerializeField, Tooltip("Unity's blend shapes range from 0 to 100")] float fullWeight = 100f;

    readonly List<(SkinnedMeshRenderer mesh, int shape, string name)> _shapes =
        new List<(SkinnedMeshRenderer, int, string)>();
    KouxingStream _stream;

    void OnEnable()
    {
        _shapes.Clear();
        foreach (var mesh in GetComponentsInChildren<SkinnedMeshRenderer>())
            for (int shape = 0; shape < mesh.sharedMesh.blendShapeCount; shape++)
            {
                // "Face.jawOpen" and "blendShape1.jawOpen" also mean jawOpen
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
        for (int i = 0; i < weights.Length; i++) face[names[i]] = weights[i];
        foreach (var (mesh, shape, name) in _shapes)
            if (face.TryGetValue(name, out float weight))
                mesh.SetBlendShapeWeight(shape, fullWeight * weight);
    }
}
