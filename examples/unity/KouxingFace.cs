// Unity 2021 or newer: add this component to an avatar. It moves every SkinnedMeshRenderer below the
// avatar that has blend shapes of ARKit, Oculus or VRM, also under the names of other programs.

using System;
using System.Collections.Generic;
using System.Linq;
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
        var names = new List<(SkinnedMeshRenderer mesh, List<string> names)>();
        foreach (var mesh in GetComponentsInChildren<SkinnedMeshRenderer>())
            names.Add((mesh, Enumerable.Range(0, mesh.sharedMesh.blendShapeCount)
                .Select(mesh.sharedMesh.GetBlendShapeName).ToList()));
        string set;
        try { set = KouxingShapeNames.ChooseSet(names.SelectMany(pair => pair.names).ToList()); }
        catch (InvalidOperationException error)
        {
            Debug.LogError($"kouxing: {error.Message}", this);
            enabled = false;
            return;
        }
        foreach (var (mesh, meshNames) in names)
            foreach (var pair in KouxingShapeNames.FindShapes(set, meshNames))
                _shapes.Add((mesh, meshNames.IndexOf(pair.Key), pair.Value));
        _stream = new KouxingStream(gateway, session, set);
    }

    void OnDisable()
    {
        _stream?.Dispose();
        _stream = null;
    }

    void LateUpdate() // after the Animator
    {
        if (_stream == null) return;
        var (names, weights) = (_stream.Names, _stream.Weights);
        if (weights.Length != names.Count) return;
        var face = new Dictionary<string, float>();
        for (int i = 0; i < weights.Length; i++) face[names[i]] = weights[i];
        foreach (var (mesh, shape, name) in _shapes)
            if (face.TryGetValue(name, out float weight))
                mesh.SetBlendShapeWeight(shape, fullWeight * weight);
    }
}
